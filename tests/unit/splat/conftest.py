"""The small world that fits are tested on."""

import pytest

from hilsplat.scene.scene import Scene
from tests.unit.splat.three_gaussians_world import three_gaussians_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Scene:
    """Three coloured Gaussians seen from nine views, two of them held out; eight points."""
    return three_gaussians_scene(tmp_path_factory.mktemp("three") / "scene")
