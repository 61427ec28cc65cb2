"""Both backends against the closed form, the slow reference and defined behaviour at the edges."""

import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch

from hilsplat.base.errors import HilsplatError
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.api import draw, pixel_weights, render, to_parameters
from hilsplat.splat.rasterise.device import Device, cuda_problem
from tests.unit.splat.rasterise_scenes import (
    FIELDS,
    camera,
    leaves,
    random_gaussians,
    round_gaussian,
    rows,
    straight_camera,
)
from tests.unit.splat.reference import render_reference


@pytest.fixture(params=get_args(Device))
def device(request):
    if request.param == "cuda" and cuda_problem():
        pytest.skip(f"no CUDA backend: {cuda_problem()}")
    return request.param


@pytest.mark.parametrize(("opacity", "scale", "depth"), [(0.8, 0.2, 2.0), (0.3, 0.05, 1.0), (0.99, 1.0, 5.0)])
def test_round_gaussian_has_the_closed_form(device, opacity, scale, depth):
    # alpha = o exp(-r^2 / (2 ((f s / z)^2 + 0.3))), r px from the principal point (16, 12)
    out = render(round_gaussian(opacity, scale, depth), straight_camera(), device=device)
    ys, xs = np.mgrid[:24, :32] + 0.5
    r2 = (xs - 16) ** 2 + (ys - 12) ** 2
    expected = opacity * np.exp(-r2 / (2 * ((30 * scale / depth) ** 2 + 0.3)))
    expected[expected < 1 / 255] = 0
    np.testing.assert_allclose(out.alpha.numpy(), expected, atol=2e-6)
    np.testing.assert_allclose(out.color.numpy(), expected[..., None].repeat(3, axis=2), atol=2e-6)


def test_background_shows_through_colour_alone(device):
    features = torch.ones(1, 2)
    wide = round_gaussian(0.5, 5.0, 2.0)
    out = render(wide, straight_camera(), background=(0.0, 1.0, 0.0), features=features, device=device)
    # in the middle alpha is 0.5: white over green; features are premultiplied
    np.testing.assert_allclose(out.color[12, 16].numpy(), [0.5, 1.0, 0.5], atol=1e-3)
    np.testing.assert_allclose(out.features[12, 16].numpy(), [0.5, 0.5], atol=1e-3)


# sizes: whole tiles, and cut ones in both directions
@pytest.mark.parametrize("size_hw", [(48, 64), (40, 56), (37, 51), (17, 5)])
@pytest.mark.parametrize(("degree", "num_features"), [(0, 0), (1, 3), (2, 9), (3, 16)])
def test_image_agrees_with_reference(device, size_hw, degree, num_features):
    gaussians, view = random_gaussians(300, seed=degree, degree=3), camera(*size_hw)
    features = torch.randn(300, num_features, generator=torch.Generator().manual_seed(1))
    out = render(gaussians, view, features=features, sh_degree=degree, device=device)
    image, alpha, _ = render_reference(gaussians, view, degree, features)
    assert alpha.max() > 0.9
    got = torch.cat([out.color, out.features], dim=2)
    # at the cliffs 1/255 and 1e-4 single pixels may differ by as much: hence quantiles
    assert torch.quantile((got - image).abs().flatten(), 0.999) < 1e-5
    assert (got - image).abs().max() < 2e-2
    assert torch.quantile((out.alpha - alpha).abs().flatten(), 0.999) < 1e-5


@pytest.mark.parametrize(("degree", "num_features"), [(0, 0), (1, 3), (2, 9), (3, 16)])
def test_gradients_agree_with_autograd_of_reference(device, degree, num_features):
    view = camera(37, 51)
    base = random_gaussians(60, seed=3, degree=degree)
    generator = torch.Generator().manual_seed(2)
    features = torch.randn(60, num_features, generator=generator)
    weight = torch.randn(*view.size_hw, 3 + num_features, generator=generator)
    alpha_weight = torch.randn(*view.size_hw, generator=generator)

    def gradients(fast: bool) -> list[torch.Tensor]:
        parameters, extra = leaves(base), features.clone().requires_grad_()
        if fast:
            out = render(
                Gaussians(*parameters), view, features=extra, background=(0.2, 0.4, 0.6), device=device
            )
            image, alpha = torch.cat([out.color, out.features], dim=2), out.alpha
        else:
            image, alpha, _ = render_reference(Gaussians(*parameters), view, degree, extra)
            behind = torch.tensor([0.2, 0.4, 0.6, *[0.0] * num_features], dtype=torch.float64)
            image = image + (1 - alpha)[..., None] * behind
        ((image * weight).sum() + (alpha * alpha_weight).sum()).backward()
        return [leaf.grad for leaf in [*parameters, extra]]

    for name, got, expected in zip((*FIELDS, "features"), gradients(True), gradients(False), strict=True):
        error = (got - expected).norm() / expected.norm().clamp(min=1e-12)
        assert error < 1e-4, f"{name}: relative error {error:.1e}"


def test_a_view_of_a_fit_has_the_images_and_gradients_of_render(device):
    gaussians, view = random_gaussians(60, seed=4), camera(37, 51)
    rng = np.random.default_rng(0)
    by_image = rng.normal(size=(37, 51, 3)).astype(np.float32)
    by_alpha = rng.normal(size=(37, 51)).astype(np.float32)
    seen = draw(to_parameters(gaussians), view, 2, threads=2, device=device)
    gradients = seen.gradients(by_image, by_alpha)
    parameters = leaves(gaussians)
    out = render(Gaussians(*parameters), view, sh_degree=2, device=device)
    (
        (out.color * torch.from_numpy(by_image)).sum() + (out.alpha * torch.from_numpy(by_alpha)).sum()
    ).backward()
    np.testing.assert_allclose(seen.image, out.color.detach().numpy(), atol=1e-6)
    np.testing.assert_allclose(seen.alpha, out.alpha.detach().numpy(), atol=1e-6)
    for name, leaf in zip(FIELDS, parameters, strict=True):
        expected = leaf.grad.numpy()
        error = np.linalg.norm(getattr(gradients, name) - expected) / np.linalg.norm(expected)
        assert error < 1e-5, name
    # undrawn Gaussians have no gradient
    assert (gradients.means_px[~seen.drawn] == 0).all()


@pytest.mark.parametrize("axis", [0, 1])
def test_screen_gradients_are_those_of_moving_the_picture(device, axis):
    # moving the principal point by d moves each projected mean by d: dL/dd is the sum of their gradients
    gaussians, view = random_gaussians(20, seed=4), camera(37, 51)
    weight = torch.randn(37, 51, 3, generator=torch.Generator().manual_seed(5))

    def loss(d: float) -> float:
        K = view.K.copy()
        K[axis, 2] += d
        image, _, _ = render_reference(gaussians, replace(view, K=K), 0)
        return float((image * weight).sum())

    seen = draw(to_parameters(gaussians), view, 0, threads=1, device=device)
    gradients = seen.gradients(weight.numpy(), np.zeros((37, 51), np.float32))
    # steps of 1e-4 px: pixels that cross 1/255 meanwhile add noise, hence the tolerance
    expected = (loss(1e-4) - loss(-1e-4)) / 2e-4
    np.testing.assert_allclose(gradients.means_px[:, axis].sum(), expected, rtol=2e-2)


def test_weights_sum_to_alpha_and_blend_to_features(device):
    gaussians, view = random_gaussians(80, seed=7), camera()
    matrix = pixel_weights(gaussians, view, min_weight=0.0, device=device)
    features = np.random.default_rng(0).normal(size=(80, 40)).astype(np.float32)
    out = render(gaussians, view, features=torch.from_numpy(features), threads=2, device=device)
    sums = np.asarray(matrix.sum(axis=1)).reshape(view.size_hw)
    np.testing.assert_allclose(sums, out.alpha.numpy(), atol=1e-6)
    blended = (matrix @ features).reshape(out.features.shape)
    np.testing.assert_allclose(blended, out.features.numpy(), atol=2e-5)
    assert matrix.has_sorted_indices
    assert all(np.all(np.diff(matrix[row].indices) > 0) for row in range(0, matrix.shape[0], 37))
    _, _, weights = render_reference(gaussians, view, 0)
    difference = np.abs(matrix.toarray() - weights.reshape(80, -1).T.numpy())
    assert np.quantile(difference, 0.999) < 1e-5


def test_small_weights_are_dropped(device):
    matrix = pixel_weights(random_gaussians(80, seed=7), camera(), min_weight=0.01, device=device)
    assert matrix.data.min() >= 0.01
    assert matrix.dtype == np.float32


def test_features_need_one_row_per_gaussian(device):
    with pytest.raises(HilsplatError, match="features do not fit"):
        render(random_gaussians(3), camera(), features=torch.zeros(4, 2), device=device)


def test_too_high_a_degree_is_refused(device):
    with pytest.raises(HilsplatError, match="degree 2"):
        render(random_gaussians(3, degree=1), camera(), sh_degree=2, device=device)


# ---- edges ----------------------------------------------------------------------------------------


def test_empty_scene_shows_the_background(device):
    parameters = leaves(rows(random_gaussians(1), slice(0, 0)))
    nothing = Gaussians(*parameters)
    features = torch.zeros(0, 4)
    out = render(nothing, camera(), background=(0.1, 0.2, 0.3), features=features, device=device)
    assert torch.equal(out.color.detach(), torch.tensor([0.1, 0.2, 0.3]).expand(40, 56, 3))
    assert out.alpha.max() == 0
    assert out.features.shape == (40, 56, 4)
    assert pixel_weights(nothing, camera(), min_weight=0.0, device=device).shape == (40 * 56, 0)


def test_gaussians_behind_the_camera_are_not_drawn(device):
    parameters = leaves(round_gaussian(0.8, 0.2, -2.0))
    out = render(Gaussians(*parameters), straight_camera(), device=device)
    out.color.sum().backward()
    assert out.alpha.max() == 0
    for leaf in parameters:
        assert torch.equal(leaf.grad, torch.zeros_like(leaf))


def test_a_gaussian_of_no_width_is_as_wide_as_the_low_pass(device):
    # s = exp(-40): alpha = o exp(-r^2 / (2 * 0.3)); the pixel (16.5, 12.5) has r^2 = 0.5
    parameters = leaves(round_gaussian(0.8, math.exp(-40), 2.0))
    out = render(Gaussians(*parameters), straight_camera(), device=device)
    np.testing.assert_allclose(out.alpha[12, 16].item(), 0.8 * math.exp(-0.5 / 0.6), rtol=1e-5)
    out.alpha.sum().backward()
    assert all(torch.isfinite(leaf.grad).all() for leaf in parameters if leaf.grad is not None)


@pytest.mark.parametrize("log_scale", [20.0, 39.0, 40.0, 90.0, 1e6])
def test_a_gaussian_far_wider_than_the_view_covers_it_evenly(log_scale):
    # s = exp(20) is 7e9 px wide here: alpha = o at every pixel, and wider ones cover no more. gsplat
    # overflows in float32
    parameters = leaves(round_gaussian(0.8, 1.0, 2.0))
    parameters[1].data[:] = log_scale
    out = render(Gaussians(*parameters), straight_camera())
    np.testing.assert_allclose(out.alpha.detach().numpy(), 0.8, rtol=1e-6)
    if log_scale <= 40:  # the reference's covariance is finite
        _, alpha, _ = render_reference(
            Gaussians(*(leaf.detach() for leaf in parameters)), straight_camera(), 0
        )
        np.testing.assert_allclose(out.alpha.detach().numpy(), alpha.numpy(), rtol=1e-6)
    out.alpha.sum().backward()
    assert all(torch.isfinite(leaf.grad).all() for leaf in parameters if leaf.grad is not None)
    # d alpha / d logit = o (1 - o) at each of 24 x 32 pixels
    np.testing.assert_allclose(parameters[3].grad.item(), 24 * 32 * 0.8 * 0.2, rtol=1e-5)
    # nothing changes as the scale does
    np.testing.assert_allclose(parameters[1].grad.numpy(), 0, atol=1e-12)


def test_a_wide_wall_aside_of_the_axis_covers_the_view_evenly():
    # exp(60) along two axes and 0.01 across, 1000 units off the axis: 15000 px, much less than its width
    parameters = leaves(round_gaussian(0.8, 0.01, 2.0))
    parameters[0].data[0, 0] = 1000.0
    parameters[1].data[0, :2] = 60.0
    out = render(Gaussians(*parameters), straight_camera())
    np.testing.assert_allclose(out.alpha.detach().numpy(), 0.8, rtol=1e-6)
    out.alpha.sum().backward()
    assert all(torch.isfinite(leaf.grad).all() for leaf in parameters if leaf.grad is not None)


def test_a_needle_has_finite_gradients_that_agree_with_the_reference():
    # exp(2) along one axis, exp(-40) across: 110 px long and as narrow as the low-pass. Terms of the
    # exponent cancel to a thousandth of their size, which costs float32 three digits
    gaussians = round_gaussian(0.8, 1.0, 2.0)
    gaussians.log_scales[:] = torch.tensor([[2.0, -40.0, -40.0]])
    gaussians.quats[:] = torch.tensor([[0.9, 0.1, -0.2, 0.3]])
    fast, slow = leaves(gaussians), leaves(gaussians, torch.float64)
    render(Gaussians(*fast), straight_camera()).color.square().sum().backward()
    image, _, _ = render_reference(Gaussians(*slow), straight_camera(), 0)
    image.square().sum().backward()
    for name, got, expected in zip(FIELDS, fast, slow, strict=True):
        assert (got.grad - expected.grad).norm() <= 3e-3 * expected.grad.norm() + 1e-6, name


def test_broken_parameters_are_counted(device):
    gaussians = random_gaussians(10)
    gaussians.means[3, 1] = math.nan
    gaussians.quats[5] = 0
    gaussians.sh[7, 2, 0] = math.inf
    with pytest.raises(HilsplatError, match="3 of 10 Gaussians cannot be drawn"):
        render(gaussians, camera(), device=device)
    with pytest.raises(HilsplatError, match="3 of 10 Gaussians cannot be drawn"):
        pixel_weights(gaussians, camera(), min_weight=0.0, device=device)


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_parameter_may_be_other_than_finite(device, field, value):
    gaussians = random_gaussians(4)
    getattr(gaussians, field)[2] = value
    with pytest.raises(HilsplatError, match="1 of 4 Gaussians cannot be drawn"):
        render(gaussians, camera(), device=device)
