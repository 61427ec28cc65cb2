"""A as an operator compared with plain loops, and key views."""

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.contributions import key_views as module
from hilsplat.contributions.kernels import BLOCK
from hilsplat.contributions.key_views import key_views
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.scene.scene import Scene
from tests.unit.two_boxes_world import NUM_GAUSSIANS, two_boxes_weights


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("channels", [3, 16, 32])
def test_products_have_the_bytes_of_plain_loops_on_any_number_of_threads(channels, threads):
    num_gaussians, rng = 2 * BLOCK + 5, np.random.default_rng(2)
    A = sp.random(14, num_gaussians, 0.002, random_state=rng, dtype=np.float32, format="csr")
    operator = MaskOperator(A, rng.integers(1, 4, 14).astype(np.uint8), threads)
    features = rng.normal(size=(num_gaussians, 3, channels)).astype(np.float32)
    values = rng.normal(size=(14, channels)).astype(np.float32)
    means, spread = np.zeros_like(values), np.zeros_like(features)
    for mask, level in enumerate(operator.level - 1):
        for k in range(A.indptr[mask], A.indptr[mask + 1]):
            gaussian, weight = A.indices[k], A.data[k]
            means[mask] += weight * features[gaussian, level]
            spread[gaussian, level] += weight * values[mask]
    assert operator.means(features).tobytes() == means.tobytes()
    assert operator.means(features.astype(np.float64)) == pytest.approx(means, abs=1e-5)
    assert operator.spread(values).tobytes() == spread.tobytes()


def test_a_share_of_the_training_views_is_chosen_in_camera_order(two_boxes, monkeypatch):
    shown = {"000.png": (0, 9), "001.png": (0, 5), "002.png": (9, 12), "003.png": (0, 2)}

    def weights(gaussians, camera, *, min_weight):
        first, last = shown[camera.name]
        matrix = two_boxes_weights(0).tolil()
        matrix[:, : 8 * first] = matrix[:, 8 * last :] = 0
        return matrix.tocsr()

    monkeypatch.setattr(module, "load_ply", lambda path: range(NUM_GAUSSIANS))
    monkeypatch.setattr(module, "pixel_weights", weights)
    scene = Scene.load(two_boxes.scene)
    assert key_views(scene, two_boxes.ply, 0.25) == ["000.png"]
    # 002 adds 24 Gaussians, and 001 half of 40
    assert key_views(scene, two_boxes.ply, 0.5) == ["000.png", "002.png"]
    assert key_views(scene, two_boxes.ply, 0.3) == ["000.png", "002.png"]  # rounded up
