"""Gaussians in memory (Morton order) and in files (3DGS PLY, SPZ)."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.scenes import random_scene
from hilsplat.base.errors import ArtifactError
from hilsplat.splat.gaussians import FIELDS, morton_order
from hilsplat.splat.ply import load_ply, save_ply
from hilsplat.splat.rasterise.api import render
from hilsplat.splat.spz import fractional_bits, spz_bytes
from tests.unit.splat.rasterise_scenes import random_gaussians, rows
from tests.unit.splat.spz_reader import decoded


def test_corners_of_a_cube_are_sorted_by_octant():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    walked = corners[morton_order(corners)].tolist()
    assert walked[:4] == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert [point[2] for point in walked] == [0] * 4 + [1] * 4
    for number in (0, 5):  # equal points keep their order
        assert morton_order(np.zeros((number, 3), np.float32)).tolist() == list(range(number))


def test_neighbours_are_close_together_despite_a_point_far_away():
    rng = np.random.default_rng(0)
    points = rng.random((4096, 3)).astype(np.float32)
    points[0] = 1e6
    order = morton_order(points)
    assert sorted(order.tolist()) == list(range(4096))
    steps = np.linalg.norm(np.diff(points[order[order != 0]], axis=0), axis=1)
    assert np.median(steps) < 0.1  # 0.66 in random order


@pytest.mark.parametrize(("n", "degree"), [(0, 1), (5, 0), (5, 1), (5, 2), (5, 3)])
def test_a_ply_is_read_back_unchanged(tmp_path, n, degree):
    gaussians = rows(random_gaussians(5, degree=degree), slice(n))
    save_ply(tmp_path / "g.ply", gaussians)
    again = load_ply(tmp_path / "g.ply")
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(gaussians, name), getattr(again, name))
    save_ply(tmp_path / "again.ply", again)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "g.ply").read_bytes()


def test_missing_and_truncated_files_are_refused(tmp_path):
    with pytest.raises(ArtifactError, match="is missing"):
        load_ply(tmp_path / "none.ply")
    save_ply(tmp_path / "g.ply", random_gaussians(3, degree=0))
    whole = (tmp_path / "g.ply").read_bytes()
    (tmp_path / "g.ply").write_bytes(whole[:-9])
    with pytest.raises(ArtifactError, match=r"g\.ply cannot be read"):
        load_ply(tmp_path / "g.ply")


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_an_spz_file_renders_nearly_the_same_picture(degree):
    gaussians, camera = random_scene(4000, (120, 160), sh_degree=degree)
    gaussians.sh[:, 1:] *= np.float32(0.2)
    order = np.random.default_rng(0).permutation(len(gaussians))
    data = spz_bytes(gaussians, order, fractional_bits(gaussians))
    found = decoded(data)
    assert len(data) < 20 * len(gaussians) + 6 * (degree + 1) ** 2 * len(gaussians)
    np.testing.assert_allclose(found.means, gaussians.means[order], atol=1e-3)
    error = np.square(render(found, camera).colours - render(gaussians, camera).colours).mean()
    assert -10 * np.log10(error) > 38


def test_the_sign_and_length_of_a_quaternion_do_not_matter():
    gaussians, _ = random_scene(50, (10, 10), sh_degree=0)
    every, bits = np.arange(50), fractional_bits(gaussians)
    other = replace(gaussians, quats=-2 * gaussians.quats)
    assert spz_bytes(gaussians, every, bits) == spz_bytes(other, every, bits)


def test_a_distant_gaussian_costs_the_others_no_precision():
    gaussians, _ = random_scene(50, (10, 10), sh_degree=0)
    means = gaussians.means.copy()
    means[0] = 1e7
    far = replace(gaussians, means=means)
    found = decoded(spz_bytes(far, np.arange(50), fractional_bits(far)))
    np.testing.assert_allclose(found.means[1:], means[1:], atol=1e-3)
    assert (found.means[0] > 500).all()
