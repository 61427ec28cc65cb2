"""The MCMC strategy: shared places look as before, the dead move, noise spares the opaque."""

import math

import numpy as np
import pytest
from scipy.special import expit, logit

from hilsplat.base.rotations import rotation_matrices
from hilsplat.scene.cameras import Camera
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.mcmc import (
    add_noise,
    add_regularisers,
    opacities,
    relocate_and_grow,
    scale_factor,
    shared_opacity,
)
from hilsplat.splat.optimise import Adam
from hilsplat.splat.rasterise.api import render
from hilsplat.splat.rasterise.cpu import Gradients

SETTINGS = GaussiansSettings(strategy="mcmc")
NO_GROWTH = SETTINGS.model_copy(update={"mcmc_growth": 0.0})


def some_gaussians(opacity: list[float], scale: float = 0.2) -> dict[str, np.ndarray]:
    n = len(opacity)
    return {
        "means": np.stack([np.arange(n), np.zeros(n), np.zeros(n)], axis=1).astype(np.float32),
        "log_scales": np.full((n, 3), math.log(scale), np.float32),
        "quats": np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        "opacity_logits": logit(np.array(opacity)).astype(np.float32),
        "sh": np.arange(3 * n, dtype=np.float32).reshape(n, 1, 3),
    }


def started(parameters: dict[str, np.ndarray]) -> Adam:
    """Adam on copies of the parameters."""
    return Adam.start({name: values.copy() for name, values in parameters.items()})


def test_two_that_share_a_place_cover_what_the_one_covered():
    # 1 - (1 - 0.5)^2 = 0.75
    assert shared_opacity(np.array([0.75]), np.array([2]))[0] == pytest.approx(0.5)
    old, number = np.array([0.01, 0.3, 0.9, 0.999, 0.7]), np.array([2, 3, 7, 51, 1])
    np.testing.assert_allclose(1 - (1 - shared_opacity(old, number)) ** number, old, rtol=1e-12)


@pytest.mark.parametrize(("opacity", "number"), [(0.3, 1), (0.3, 2), (0.8, 5), (0.99, 20), (0.999, 51)])
def test_scale_factor_is_the_papers_double_sum(opacity, number):
    new = 1 - (1 - opacity) ** (1 / number)
    total = 0.0
    for i in range(1, number + 1):
        for k in range(i):
            total += math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
    found = scale_factor(np.array([opacity]), np.array([new]), np.array([number]))[0]
    assert found == pytest.approx(opacity / total, rel=1e-9)


@pytest.mark.parametrize(("opacity", "number"), [(0.3, 2), (0.8, 5), (0.99, 20)])
def test_the_profile_keeps_its_integral(opacity, number):
    new = shared_opacity(np.array([opacity]), np.array([number]))
    factor = scale_factor(np.array([opacity]), new, np.array([number]))[0]
    x = np.linspace(-12, 12, 24001)
    one = opacity * np.exp(-(x**2) / 2)
    many = 1 - (1 - new[0] * np.exp(-((x / factor) ** 2) / 2)) ** number
    assert np.trapezoid(many, x) == pytest.approx(np.trapezoid(one, x), rel=1e-6)


def test_a_relocated_gaussian_leaves_the_picture_as_it_was():
    parameters = some_gaussians([0.6, 0.001])
    parameters["means"] = np.float32([[0, 0, 0], [0.1, 0.3, 0]])
    parameters["sh"] = np.float32([[[1, 0, -1]], [[0, 1, 0]]])
    adam = started(parameters)
    relocate_and_grow(adam, NO_GROWTH, np.random.default_rng(0))
    np.testing.assert_array_equal(adam.parameters["means"], 0)
    np.testing.assert_allclose(opacities(adam), 1 - math.sqrt(0.4), rtol=1e-5)
    pose = np.eye(4)
    pose[2, 3] = 3
    camera = Camera("v", pose, np.array([[60, 0, 24], [0, 60, 24], [0, 0, 1.0]]), (48, 48))

    def picture(values: dict[str, np.ndarray]) -> np.ndarray:
        return render(Gaussians(**values), camera).color

    before, after = picture(parameters), picture(adam.parameters)
    # equal at the centre; the profile's shape changes a little (paper, Fig. 3), its sum does not
    np.testing.assert_allclose(after[24, 24], before[24, 24], atol=0.01)
    assert np.abs(after - before).max() < 0.03
    assert after.sum() == pytest.approx(before.sum(), rel=0.05)


def test_dead_gaussians_move_onto_living_ones_and_moments_are_reset():
    adam = Adam.start(some_gaussians([0.9, 0.004, 0.5, 0.001]))
    for table in (adam.first, adam.second):
        for values in table.values():
            values[:] = 1
    relocate_and_grow(adam, NO_GROWTH, np.random.default_rng(1))
    assert len(adam) == 4
    assert set(adam.parameters["means"][:, 0]) <= {0.0, 2.0}
    moved = adam.parameters["means"][[1, 3], 0]
    for source in (0, 2):
        members = np.flatnonzero(adam.parameters["means"][:, 0] == source)
        covered = 1 - np.prod(1 - opacities(adam)[members])
        assert covered == pytest.approx([0.9, None, 0.5][source], rel=1e-4)
        touched = source in moved
        assert (adam.first["means"][members] == (0 if touched else 1)).all()


@pytest.mark.parametrize(("min_opacity", "opacity"), [(0.005, 0.1), (0.003, 0.1), (0.1, 0.6), (0.5, 0.9)])
def test_gaussians_that_share_a_place_stay_alive(min_opacity, opacity):
    # an equal share for 51 would be 0.002, 0.002, 0.018 or 0.044: below each threshold
    adam = Adam.start(some_gaussians([opacity] + [min_opacity / 2] * 200))
    settings = NO_GROWTH.model_copy(update={"min_opacity": min_opacity})
    relocate_and_grow(adam, settings, np.random.default_rng(0))
    assert (opacities(adam) > min_opacity).all()
    np.testing.assert_allclose(opacities(adam), min_opacity, rtol=1e-5)
    before = {name: values.copy() for name, values in adam.parameters.items()}
    relocate_and_grow(adam, settings, np.random.default_rng(1))
    for name, values in before.items():
        np.testing.assert_array_equal(adam.parameters[name], values)


def test_growth_is_a_share_and_stops_at_the_cap():
    adam = Adam.start(some_gaussians([0.5] * 40))
    settings = SETTINGS.model_copy(update={"mcmc_growth": 0.05, "max_gaussians": 43})
    relocate_and_grow(adam, settings, np.random.default_rng(0))
    assert len(adam) == 42  # 5 % of 40
    for _ in range(2):
        relocate_and_grow(adam, settings, np.random.default_rng(0))
        assert len(adam) == 43
    # places are as opaque as they were, however many share them
    for place in range(40):
        members = adam.parameters["means"][:, 0] == place
        assert 1 - np.prod(1 - opacities(adam)[members]) == pytest.approx(0.5, rel=1e-4)


def test_places_are_drawn_by_their_opacity():
    adam = Adam.start(some_gaussians([0.8, 0.2] + [0.0001] * 4000))
    relocate_and_grow(adam, NO_GROWTH, np.random.default_rng(0))
    share = (adam.parameters["means"][2:, 0] == 0).mean()
    assert share == pytest.approx(0.8, abs=0.02)  # standard error 0.006


def test_noise_is_normal_numbers_times_the_covariance_and_spares_opaque_gaussians():
    opacity = np.array([0.004, 0.005, 0.015] * 10 + [0.99] * 2)
    parameters = some_gaussians(opacity.tolist())
    generator = np.random.default_rng(2)
    parameters["log_scales"] = np.log(generator.uniform(0.001, 0.02, (32, 3))).astype(np.float32)
    parameters["quats"] = (3 * generator.normal(size=(32, 4))).astype(np.float32)
    adam = started(parameters)
    add_noise(adam, SETTINGS, 1e-4, 2.0, np.random.default_rng(0))
    normal = np.random.default_rng(0).standard_normal((32, 3), dtype=np.float32)
    root = rotation_matrices(parameters["quats"]) * np.exp(parameters["log_scales"].astype(float))[:, None]
    gate = expit(-100 * (opacity - 0.005))[:, None]
    # lengths in units of the extent 2, and back
    expected = 5e5 * 1e-4 * gate * np.einsum("nij,nkj,nk->ni", root, root, normal) / 2
    # means lie up to 30 from 0, where float32 steps by 2e-6
    np.testing.assert_allclose(adam.parameters["means"] - parameters["means"], expected, atol=2e-6)
    np.testing.assert_array_equal(adam.parameters["means"][30:], parameters["means"][30:])


def test_noise_does_not_depend_on_the_unit_of_the_scene():
    shifts = []
    for size in (1.0, 10.0):
        parameters = some_gaussians([0.004] * 5, scale=0.02 * size)
        parameters["means"] *= size
        adam = started(parameters)
        add_noise(adam, SETTINGS, 1e-4, 3.0 * size, np.random.default_rng(0))
        shifts.append((adam.parameters["means"] - parameters["means"])[0] / size)
    np.testing.assert_allclose(shifts[1], shifts[0], rtol=1e-4)


def test_regularisers_add_the_gradient_of_mean_opacity_and_mean_scale():
    adam = Adam.start(some_gaussians([0.5, 0.2], scale=0.3))
    zeros = {name: np.zeros_like(values) for name, values in adam.parameters.items()}
    gradients = Gradients(
        **zeros, features=np.zeros((2, 0), np.float32), means_px=np.zeros((2, 2), np.float32)
    )
    settings = SETTINGS.model_copy(update={"mcmc_opacity_weight": 0.1, "mcmc_scale_weight": 0.6})
    add_regularisers(adam, gradients, settings, extent=2.0)
    # 0.1 / 2 x o (1 - o); 0.6 / (3 x 2) x 0.3 / 2
    np.testing.assert_allclose(gradients.opacity_logits, [0.05 * 0.25, 0.05 * 0.16], rtol=1e-5)
    np.testing.assert_allclose(gradients.log_scales, 0.015, rtol=1e-5)
