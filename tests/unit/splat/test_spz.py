"""Gaussians as SPZ: read back by the format's description, they draw nearly the same picture."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.scenes import random_scene
from hilsplat.splat.rasterise.api import render
from hilsplat.splat.spz import fractional_bits, spz_bytes
from tests.unit.splat.spz_reader import decoded


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_picture_of_what_is_read_back(degree):
    gaussians, camera = random_scene(4000, (120, 160), sh_degree=degree)
    gaussians = replace(
        gaussians,
        sh=gaussians.sh
        * np.array([1.0, 0.2])[[0] + [1] * (gaussians.sh.shape[1] - 1), None].astype(np.float32),
    )
    rows = np.random.default_rng(0).permutation(len(gaussians))
    data = spz_bytes(gaussians, rows, fractional_bits(gaussians))
    found = decoded(data)
    assert len(data) < 20 * len(gaussians) + 6 * (degree + 1) ** 2 * len(gaussians)
    np.testing.assert_allclose(found.means, gaussians.means[rows], atol=1e-3)
    error = np.square(render(found, camera).color - render(gaussians, camera).color).mean()
    assert -10 * np.log10(error) > 38


def test_the_same_rotation_whatever_the_sign_and_length_of_its_quaternion():
    gaussians, _ = random_scene(50, (10, 10), sh_degree=0)
    rows, bits = np.arange(50), fractional_bits(gaussians)
    other = replace(gaussians, quats=-2 * gaussians.quats)
    assert spz_bytes(gaussians, rows, bits) == spz_bytes(other, rows, bits)


def test_a_gaussian_very_far_away_costs_the_others_no_precision():
    gaussians, _ = random_scene(50, (10, 10), sh_degree=0)
    means = gaussians.means.copy()
    means[0] = 1e7
    far = replace(gaussians, means=means)
    found = decoded(spz_bytes(far, np.arange(50), fractional_bits(far)))
    np.testing.assert_allclose(found.means[1:], means[1:], atol=1e-3)
    assert (found.means[0] > 500).all()
