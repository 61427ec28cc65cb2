"""Training cameras are outside all objects, and many are close to one."""

import numpy as np
import pytest

from hilsplat.world.render import label_view
from hilsplat.world.scenes.kinds import KINDS, build_scene
from models.training.cameras import training_camera


@pytest.mark.parametrize("kind", KINDS)
def test_training_cameras_show_several_objects_and_half_are_close_ups(kind):
    scene, rng = build_scene(kind, 100, 7), np.random.default_rng(0)
    close = 0
    for _ in range(40):
        whole, part, _ = label_view(scene, training_camera(scene, rng, 32))
        # From inside a wall or an object, everything belongs to it.
        assert len(np.unique(whole)) > 1 and len(np.unique(part)) > 2
        close += np.isin(whole[10:22, 10:22], list(scene.background), invert=True).mean() > 0.3
    assert close >= 15
