"""Gaussians moved by a similarity look the same from a camera that moved with them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilsplat.base.errors import HilsplatError
from hilsplat.scene.assemble import move_cameras
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.api import render
from hilsplat.splat.similarity import decompose, move_gaussians, sh_basis, sh_rotation
from tests.unit.splat.reference import SH


def turned(seed: int) -> np.ndarray:
    return Rotation.random(rng=np.random.default_rng(seed)).as_matrix()


def directions(number: int) -> np.ndarray:
    values = np.random.default_rng(5).normal(size=(number, 3))
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def random_gaussians(degree: int) -> Gaussians:
    """Forty in a box of side 2 about the origin, of every colour and shape."""
    generator = np.random.default_rng(degree)
    n = 40
    return Gaussians(
        generator.uniform(-1, 1, (n, 3)).astype(np.float32),
        np.log(generator.uniform(0.05, 0.4, (n, 3))).astype(np.float32),
        generator.normal(size=(n, 4)).astype(np.float32),
        generator.normal(size=n).astype(np.float32),
        generator.normal(size=(n, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def test_basis_is_that_of_3dgs():
    d = directions(30)
    expected = np.stack([harmonic(*d.T) for harmonic in SH], axis=1)
    np.testing.assert_allclose(sh_basis(d, 3), expected, atol=1e-14)


def test_linear_band_turns_like_a_vector():
    # about z by 90 degrees: what was along x is along y. 3DGS: row 1 is -y, row 2 is z, row 3 is -x
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    along_x = np.array([0, 0, 0, -1.0])
    np.testing.assert_allclose(sh_rotation(quarter, 1) @ along_x, [0, -1, 0, 0], atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_harmonics_show_the_old_colour_along_the_turned_direction(degree):
    rotation, d = turned(degree), directions(50)
    coefficients = np.random.default_rng(1).normal(size=(degree + 1) ** 2)
    before = sh_basis(d, degree) @ coefficients
    after = sh_basis(d @ rotation.T, degree) @ (sh_rotation(rotation, degree) @ coefficients)
    np.testing.assert_allclose(after, before, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_rendered_view_is_unchanged_under_a_similarity(degree):
    gaussians = random_gaussians(degree)
    pose = np.eye(4)
    pose[:3, :3] = turned(9)
    pose[:3, 3] = (0.1, -0.2, 4.0)
    K = np.array([[60, 0, 25.0], [0, 66, 19.0], [0, 0, 1]])
    similarity = np.eye(4)
    similarity[:3, :3] = 0.37 * turned(7)
    similarity[:3, 3] = (5.0, -3.0, 2.0)
    before = render(gaussians, Camera("v", pose, K, (40, 56)))
    moved_pose = move_cameras(pose[None], similarity)[0]
    after = render(move_gaussians(gaussians, similarity), Camera("v", moved_pose, K, (40, 56)))
    assert before.alpha.mean() > 0.2
    # float32 parameters; a pixel at the cut of 1/255 may fall on either side
    np.testing.assert_allclose(after.color, before.color, atol=5e-3)
    assert np.abs(after.color - before.color).mean() < 1e-5


def test_there_and_back_is_nothing():
    gaussians = random_gaussians(3)
    similarity = np.eye(4)
    similarity[:3, :3] = 4 * turned(3)
    similarity[:3, 3] = (1, 2, 3)
    back = move_gaussians(move_gaussians(gaussians, similarity), np.linalg.inv(similarity))
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(back, name), getattr(gaussians, name), atol=1e-5)
    # a quaternion and its negative are the same rotation
    first, second = (
        quats / np.linalg.norm(quats, axis=1)[:, None] for quats in (back.quats, gaussians.quats)
    )
    np.testing.assert_allclose(np.abs((first * second).sum(axis=1)), 1, atol=1e-6)


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.0, 2.0, 1.0, 1.0]), np.full((4, 4), np.nan)],
    ids=["mirrors", "stretches", "not finite"],
)
def test_a_matrix_that_is_not_a_similarity_is_refused(matrix):
    with pytest.raises(HilsplatError, match="not a similarity"):
        decompose(matrix)


def test_a_similarity_is_decomposed():
    scale, rotation, translation = decompose(np.diag([2.0, 2.0, 2.0, 1.0]))
    assert scale == pytest.approx(2, rel=1e-12)
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
    assert translation.tolist() == [0, 0, 0]
