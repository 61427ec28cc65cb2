"""Key views cover the scene before they repeat."""

import numpy as np

from hilsplat.contributions.key_views import key_views, most_covering
from tests.unit.two_boxes_world import NUM_GAUSSIANS


def test_views_that_add_most_come_first():
    seen = np.array([[1, 1, 1, 0], [1, 1, 0, 0], [0, 0, 0, 1]], bool)
    # row 0 sees most; then row 2 adds 1, and row 1 half of 2 again, the first of equal ones
    assert most_covering(seen, np.array([1.0, 1, 1, 1]), 3) == [0, 1, 2]
    assert most_covering(seen, np.array([1.0, 1, 1, 2]), 2) == [0, 2]


def test_a_share_of_the_training_views_is_chosen_in_camera_order(two_boxes, monkeypatch):
    from hilsplat.contributions import key_views as module
    from hilsplat.scene.scene import Scene
    from tests.unit.two_boxes_world import two_boxes_weights

    shown = {"000.png": 4, "001.png": 1, "002.png": 9, "003.png": 2}

    def weights(gaussians, camera, *, min_weight):
        matrix = two_boxes_weights(0).tolil()
        matrix[:, shown[camera.name] * NUM_GAUSSIANS // 10 :] = 0  # the first Gaussians only
        return matrix.tocsr()

    monkeypatch.setattr(module, "load_ply", lambda path: None)
    monkeypatch.setattr(module, "pixel_weights", weights)
    scene = Scene.load(two_boxes.scene)
    assert key_views(scene, two_boxes.ply, 0.5) == ["000.png", "002.png"]
    assert key_views(scene, two_boxes.ply, 0.3) == ["000.png", "002.png"]  # rounded up
    assert key_views(scene, two_boxes.ply, 0.25) == ["002.png"]
