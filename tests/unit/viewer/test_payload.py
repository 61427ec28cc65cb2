"""What the page gets: packed Gaussians and nodes give back what was packed."""

from dataclasses import replace

import numpy as np
import pytest

from hilsplat.scene.cameras import Cameras
from hilsplat.splat.gaussians import Gaussians
from hilsplat.viewer.payload import HEADER, MAGIC, crossing, packed_gaussians, packed_nodes, upright


def some_gaussians(n: int, bases: int, rng: np.random.Generator) -> Gaussians:
    shapes = {
        "means": (n, 3),
        "log_scales": (n, 3),
        "quats": (n, 4),
        "opacity_logits": (n,),
        "sh": (n, bases, 3),
    }
    return Gaussians(**{name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()})


@pytest.mark.parametrize("bases", [1, 4, 9, 16])
def test_packed_gaussians_can_be_read_back(bases):
    gaussians = some_gaussians(5, bases, np.random.default_rng(1))
    data = packed_gaussians(gaussians)
    magic, n, found_bases, texels = HEADER.unpack(data[: HEADER.size])
    assert (magic, n, found_bases) == (MAGIC, 5, bases) and HEADER.size == 32
    assert len(data) == 32 + 5 * (32 + 16 * texels)
    rows = np.frombuffer(data, np.float32, 8 * n, 32).reshape(n, 8)
    np.testing.assert_array_equal(rows[:, :3], gaussians.means)
    np.testing.assert_allclose(rows[:, 3], gaussians.opacities, rtol=1e-6)
    halves = np.ascontiguousarray(rows[:, 4:]).view(np.float16).reshape(n, 8).astype(np.float32)
    np.testing.assert_allclose(halves[:, :3], gaussians.log_scales, rtol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(halves[:, 4:], axis=1), 1, atol=1e-3)
    turned = halves[:, 4:] * np.sign((halves[:, 4:] * gaussians.quats).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(
        turned, gaussians.quats / np.linalg.norm(gaussians.quats, axis=1)[:, None], atol=1e-3
    )
    harmonics = np.frombuffer(data, np.float16, offset=32 + 32 * n).reshape(n, -1)[:, : 3 * bases]
    np.testing.assert_allclose(harmonics, gaussians.sh.reshape(n, -1), rtol=1e-3)


def test_huge_scales_are_cut_as_the_rasteriser_cuts_them():
    gaussians = some_gaussians(2, 1, np.random.default_rng(2))
    packed = packed_gaussians(replace(gaussians, log_scales=np.full((2, 3), 90, np.float32)))
    halves = np.frombuffer(packed, np.float16, 8, 32 + 16)
    assert halves[:3].tolist() == [20, 20, 20]


def test_packed_nodes_are_numbered_from_one_and_zero_is_none(shown):
    tree = shown.answering("default").tree
    texels = np.frombuffer(packed_nodes(tree), np.uint16).reshape(-1, 4)
    np.testing.assert_array_equal(texels[:, :3].astype(int) - 1, tree.node_of_gaussian)


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


def test_a_visitor_turns_about_what_the_cameras_look_at():
    focus = np.array([1.0, -2.0, 3.0])
    cameras = cameras_around(focus)
    np.testing.assert_allclose(crossing(cameras), focus, atol=0.02)
    up = upright(cameras)
    assert np.linalg.norm(up) == pytest.approx(1) and up @ [0, -1, 0] > 0.9


def test_parallel_cameras_turn_about_a_point_in_front_of_them(shown):
    cameras = shown.scene.cameras
    ahead = cameras.cam_from_world[0, 2, :3]
    assert (crossing(cameras) - cameras[cameras.names[0]].centre) @ ahead > 0
