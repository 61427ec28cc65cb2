"""Quaternions and rotation matrices, against scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cpusplat.compiled import compiled
from cpusplat.project import matrix_entries
from hilsplat.base.rotations import are_rotations, multiply, quaternion_of, rotate, unit_quaternions

GENERATOR = np.random.default_rng(3)
RANDOM = GENERATOR.normal(size=(50, 4)) * GENERATOR.uniform(0.01, 100, (50, 1))
"""Quaternions wxyz of any length."""


def by_scipy(quats: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()


@compiled
def in_a_loop(quats, out):
    for i in range(len(quats)):
        entries = matrix_entries(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
        for k in range(9):
            out[i, k // 3, k % 3] = entries[k]


def test_matrices_in_compiled_loops_equal_scipys():
    out = np.empty((len(RANDOM), 3, 3))
    in_a_loop(unit_quaternions(RANDOM), out)
    np.testing.assert_allclose(out, by_scipy(RANDOM), atol=1e-14)


def test_a_matrix_gives_its_quaternion_up_to_the_sign():
    for matrix, quat in zip(by_scipy(RANDOM), unit_quaternions(RANDOM), strict=True):
        found = quaternion_of(matrix)
        np.testing.assert_allclose(found * np.sign(found @ quat), quat, atol=1e-12)


def test_rotation_by_a_quaternion_equals_rotation_by_its_matrix():
    vectors = np.random.default_rng(4).normal(size=(50, 3))
    turned = np.einsum("nij,nj->ni", by_scipy(RANDOM), vectors)
    np.testing.assert_allclose(rotate(unit_quaternions(RANDOM), vectors), turned, atol=1e-12)


def test_a_product_rotates_by_the_right_factor_first():
    left = np.array([0.5, -0.5, 0.1, 2.0])
    both = multiply(left, RANDOM)
    expected = by_scipy(left[None]) @ by_scipy(RANDOM)
    np.testing.assert_allclose(by_scipy(both), expected, atol=1e-12)
    lengths = np.linalg.norm(left) * np.linalg.norm(RANDOM, axis=1)
    np.testing.assert_allclose(np.linalg.norm(both, axis=1), lengths)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda matrix: matrix * [1, 1, -1],  # a mirror
        lambda matrix: matrix * 1.01,
        lambda matrix: matrix + np.diag([0.01, 0], k=1),  # a shear
        lambda matrix: np.where(np.eye(3) > 0, np.nan, matrix),
        lambda matrix: np.where(np.eye(3) > 0, np.inf, matrix),
        np.zeros_like,
    ],
)
def test_matrices_that_are_no_rotations_are_found(spoil):
    matrices = by_scipy(RANDOM[:5])
    assert are_rotations(matrices, 1e-12).all()
    matrices[2] = spoil(matrices[2])
    assert are_rotations(matrices, 1e-3).tolist() == [True, True, False, True, True]
    assert not are_rotations(matrices[2], 1e-3)
