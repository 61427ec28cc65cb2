"""Data of the page: chunks of Gaussians, their nodes, the initial focus point."""

import gzip

import numpy as np
import pytest

from hilsplat.scene.cameras import Cameras
from hilsplat.splat.gaussians import Gaussians
from hilsplat.viewer import payload
from hilsplat.viewer.payload import arrival_order, crossing, packed_nodes, upright


def test_the_first_chunk_has_the_most_visible_gaussians():
    n = payload.CHUNK + 100
    rng = np.random.default_rng(1)
    scales = rng.uniform(-6, 0, n)
    gaussians = Gaussians(
        means=rng.normal(size=(n, 3)).astype(np.float32),
        log_scales=np.repeat(scales[:, None], 3, axis=1).astype(np.float32),
        quats=np.ones((n, 4), np.float32),
        opacity_logits=np.zeros(n, np.float32),
        sh=np.zeros((n, 1, 3), np.float32),
    )
    order = arrival_order(gaussians)
    assert sorted(order) == list(range(n))
    assert scales[order[: payload.CHUNK]].min() >= scales[order[payload.CHUNK :]].max()


def test_packed_nodes_are_numbered_from_one(shown):
    tree = shown.answering("default").tree
    data = gzip.decompress(packed_nodes(tree, shown.order))
    texels = np.frombuffer(data, np.uint16).reshape(-1, 4)
    np.testing.assert_array_equal(texels[:, :3].astype(int) - 1, tree.node_of_gaussian[shown.order])


def cameras_around(focus: np.ndarray, number: int = 5) -> Cameras:
    """Cameras on a ring that look at a point, with y down."""
    poses = np.tile(np.eye(4), (number, 1, 1))
    for row, angle in enumerate(np.linspace(0, 2, number)):
        centre = focus + 4 * np.array([np.sin(angle), -0.3, -np.cos(angle)])
        ahead = (focus - centre) / np.linalg.norm(focus - centre)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        poses[row, :3, :3] = np.stack([right, np.cross(ahead, right), ahead])
        poses[row, :3, 3] = -poses[row, :3, :3] @ centre
    names = tuple(f"{row}.png" for row in range(number))
    sizes = np.full((number, 2), 10, np.int32)
    return Cameras(names, poses, np.tile(np.diag([10.0, 10, 1]), (number, 1, 1)), sizes)


def test_the_focus_is_the_point_that_the_cameras_look_at():
    focus = np.array([1.0, -2.0, 3.0])
    cameras = cameras_around(focus)
    np.testing.assert_allclose(crossing(cameras), focus, atol=0.02)
    up = upright(cameras)
    assert np.linalg.norm(up) == pytest.approx(1) and up @ [0, -1, 0] > 0.9


def test_the_focus_of_parallel_cameras_is_in_front_of_them(shown):
    cameras = shown.scene.cameras
    ahead = cameras.cam_from_world[0, 2, :3]
    assert (crossing(cameras) - cameras[cameras.names[0]].centre) @ ahead > 0
