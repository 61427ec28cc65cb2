"""Data of the page: chunks of Gaussians, their nodes, the initial focus point."""

import gzip
from dataclasses import replace

import numpy as np
import pytest

from hilsplat.viewer import payload
from hilsplat.viewer.payload import arrival_order, crossing, packed_nodes, upright
from tests.unit.evaluate.builders import cameras_of
from tests.unit.round_gaussians import round_gaussians


def test_the_first_chunk_has_the_most_visible_gaussians():
    n = payload.CHUNK + 100
    rng = np.random.default_rng(1)
    scales = rng.uniform(-6, 0, n).astype(np.float32)
    gaussians = round_gaussians(rng.normal(size=(n, 3)))
    order = arrival_order(replace(gaussians, log_scales=np.repeat(scales[:, None], 3, axis=1)))
    assert sorted(order) == list(range(n))
    assert scales[order[: payload.CHUNK]].min() >= scales[order[payload.CHUNK :]].max()


def test_packed_nodes_are_numbered_from_one(shown):
    tree = shown.answering("default").tree
    data = gzip.decompress(packed_nodes(tree, shown.order))
    texels = np.frombuffer(data, np.uint16).reshape(-1, 4)
    np.testing.assert_array_equal(texels[:, :3].astype(int) - 1, tree.node_of_gaussian[shown.order])


def test_the_focus_is_the_point_that_the_cameras_look_at():
    focus = np.array([1.0, -2.0, 3.0])
    poses = np.tile(np.eye(4), (5, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 2, 5), strict=True):  # on a ring, with y down
        centre = focus + 4 * np.array([np.sin(angle), -0.3, -np.cos(angle)])
        ahead = (focus - centre) / np.linalg.norm(focus - centre)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
        pose[:3, 3] = -pose[:3, :3] @ centre
    cameras = cameras_of(poses, np.diag([10.0, 10, 1]), (10, 10))
    np.testing.assert_allclose(crossing(cameras), focus, atol=0.02)
    up = upright(cameras)
    assert np.linalg.norm(up) == pytest.approx(1) and up @ [0, -1, 0] > 0.9


def test_the_focus_of_parallel_cameras_is_in_front_of_them(shown):
    cameras = shown.scene.cameras
    ahead = cameras.cam_from_world[0, 2, :3]
    assert (crossing(cameras) - cameras[cameras.names[0]].centre) @ ahead > 0
