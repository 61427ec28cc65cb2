"""The CPU backend against the closed form, the slow reference and defined behaviour at the edges."""

import math

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from cpusplat.views import Parameters
from hilsplat.base.errors import HilsplatError
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise.api import draw, pixel_weights, render
from tests.cpusplat.gsplat_on_cpu import rasterization_of_view, spherical_harmonics
from tests.unit.splat.rasterise_scenes import camera, random_gaussians, round_gaussian, rows, straight_camera


def render_reference(
    gaussians: Gaussians | list[Tensor],
    camera: Camera,
    degree: int,
    features: Float[Tensor, "N D"] | None = None,
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"]]:
    """Premultiplied RGB (+ features) and alpha; every Gaussian is evaluated at every pixel, in float64."""
    fields = gaussians if isinstance(gaussians, list) else vars(gaussians).values()
    means, log_scales, quats, logits, sh = (torch.as_tensor(field).double() for field in fields)
    pose, K, centre = map(torch.from_numpy, (camera.cam_from_world, camera.K, camera.centre))
    channels = (spherical_harmonics(degree, means - centre, sh) + 0.5).clamp(min=0)
    if features is not None:
        channels = torch.cat([channels, features.double()], dim=1)
    given = means, quats, log_scales.exp(), logits.sigmoid(), channels
    image, alpha, _ = rasterization_of_view(*given, pose, K, *camera.size_hw[::-1])
    return image[0], alpha[0, ..., 0]


def leaves(gaussians: Gaussians) -> list[Tensor]:
    """The parameters as float64 tensors that gather gradients."""
    return [torch.from_numpy(getattr(gaussians, name).astype(np.float64)).requires_grad_() for name in FIELDS]


def relative_errors(found: Parameters, leaves: list[Tensor]) -> dict[str, float]:
    """Return the error of each gradient relative to that of its leaf."""
    errors = {}
    for name, leaf in zip(FIELDS, leaves, strict=True):
        expected = leaf.grad.numpy()
        error = np.linalg.norm(getattr(found, name) - expected)
        errors[name] = float(error / max(np.linalg.norm(expected), 1e-12))
    return errors


@pytest.mark.parametrize(("opacity", "scale", "depth"), [(0.8, 0.2, 2.0), (0.3, 0.05, 1.0), (0.99, 1.0, 5.0)])
def test_a_round_gaussian_has_the_closed_form(opacity, scale, depth):
    # alpha = o exp(-r^2 / (2 ((f s / z)^2 + 0.3))), r px from the principal point (16, 12)
    rows, columns = np.mgrid[:24, :32] + 0.5
    r2 = (columns - 16) ** 2 + (rows - 12) ** 2
    expected = opacity * np.exp(-r2 / (2 * ((30 * scale / depth) ** 2 + 0.3)))
    expected[expected < 1 / 255] = 0
    grey = expected[..., None].repeat(3, axis=2)
    seen = draw(round_gaussian(opacity, scale, depth), straight_camera(), 0)
    np.testing.assert_allclose(seen.alpha, expected, atol=2e-6)
    np.testing.assert_allclose(seen.image, grey, atol=2e-6)
    image, alpha = render_reference(round_gaussian(opacity, scale, depth), straight_camera(), 0)
    # the parameters are float32
    np.testing.assert_allclose(alpha.numpy(), expected, rtol=2e-6, atol=1e-7)
    np.testing.assert_allclose(image.numpy(), grey, rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize(("depths", "expected"), [((4.0, 2.0), [0.25, 0.5]), ((2.0, 2.0), [0.5, 0.25])])
def test_gaussians_blend_front_to_back_and_at_equal_depths_in_row_order(depths, expected):
    # both have alpha 0.5 everywhere, because they are wide
    pair = [round_gaussian(0.5, 100.0, depth) for depth in depths]
    both = Gaussians(*(np.concatenate([getattr(g, name) for g in pair]) for name in FIELDS))
    image, _ = render_reference(both, straight_camera(), 0, torch.eye(2))
    np.testing.assert_allclose(image[12, 16, 3:].numpy(), expected, atol=1e-6)
    found = pixel_weights(both, straight_camera(), min_weight=0.0)
    np.testing.assert_allclose(found[12 * 32 + 16].toarray()[0], expected, atol=1e-6)


def test_the_background_shows_through():
    color = render(round_gaussian(0.5, 5.0, 2.0), straight_camera(), background=(0.0, 1.0, 0.0)).colours
    # in the middle alpha is 0.5: white over green
    np.testing.assert_allclose(color[12, 16], [0.5, 1.0, 0.5], atol=1e-3)


# sizes: whole tiles, and cut ones in both directions
@pytest.mark.parametrize("size_hw", [(48, 64), (40, 56), (37, 51), (17, 5)])
@pytest.mark.parametrize(("degree", "num_features"), [(0, 0), (1, 3), (2, 9), (3, 16)])
def test_image_agrees_with_reference(size_hw, degree, num_features):
    gaussians, view = random_gaussians(300, seed=degree, degree=3), camera(*size_hw)
    features = np.random.default_rng(1).standard_normal((300, num_features), np.float32)
    seen = draw(gaussians, view, degree, features=features)
    image, alpha = render_reference(gaussians, view, degree, torch.from_numpy(features))
    assert alpha.max() > 0.9
    error = np.abs(seen.image - image.numpy())
    # at the cliffs 1/255 and 1e-4 single pixels may differ by as much: hence quantiles
    assert np.quantile(error, 0.999) < 1e-5
    assert error.max() < 2e-2
    assert np.quantile(np.abs(seen.alpha - alpha.numpy()), 0.999) < 1e-5


@pytest.mark.parametrize("stretch", [0.0, 3.0])
def test_long_lists_of_faint_needles_agree_with_the_reference(stretch):
    # one tile holds them all, several chunks of its list; needles pass between the pixels of most blocks
    gaussians, view = random_gaussians(500, seed=11, degree=0), camera(16, 16, focal=20.0)
    gaussians.opacity_logits[:] -= 3
    gaussians.log_scales[:, 0] += stretch
    gaussians.log_scales[:, 1:] -= stretch
    by_image = np.random.default_rng(0).standard_normal((16, 16, 3), np.float32)
    seen = draw(gaussians, view, 0)
    found, _ = seen.gradients(by_image, np.zeros((16, 16), np.float32))
    parameters = leaves(gaussians)
    image, _ = render_reference(parameters, view, 0)
    (image * torch.from_numpy(by_image)).sum().backward()
    assert np.quantile(np.abs(seen.image - image.detach().numpy()), 0.99) < 2e-5
    assert max(relative_errors(found, parameters).values()) < 1e-3


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_agree_with_autograd_of_reference(degree):
    view, gaussians = camera(37, 51), random_gaussians(60, seed=3, degree=degree)
    rng = np.random.default_rng(2)
    by_image, by_alpha = (rng.standard_normal((37, 51, *more), np.float32) for more in ((3,), ()))
    seen = draw(gaussians, view, degree, threads=2)
    found, by_mean_px = seen.gradients(by_image, by_alpha)
    parameters = leaves(gaussians)
    image, alpha = render_reference(parameters, view, degree)
    ((image * torch.from_numpy(by_image)).sum() + (alpha * torch.from_numpy(by_alpha)).sum()).backward()
    assert max(relative_errors(found, parameters).values()) < 1e-4
    # undrawn Gaussians have no gradient
    assert (by_mean_px[~seen.drawn] == 0).all()


def test_weights_sum_to_alpha_and_blend_to_features():
    gaussians, view = random_gaussians(80, seed=7), camera()
    matrix = pixel_weights(gaussians, view, min_weight=0.0)
    features = np.random.default_rng(0).normal(size=(80, 40)).astype(np.float32)
    seen = draw(gaussians, view, 0, features=features, threads=2)
    sums = np.asarray(matrix.sum(axis=1)).reshape(view.size_hw)
    np.testing.assert_allclose(sums, seen.alpha, atol=1e-6)
    np.testing.assert_allclose(matrix @ features, seen.image[..., 3:].reshape(-1, 40), atol=2e-5)
    assert matrix.has_sorted_indices and matrix.dtype == np.float32
    assert pixel_weights(gaussians, view, min_weight=0.01).data.min() >= 0.01
    assert all(np.all(np.diff(matrix[row].indices) > 0) for row in range(0, matrix.shape[0], 37))
    image, _ = render_reference(gaussians, view, 0, torch.eye(80))
    difference = np.abs(matrix.toarray() - image[..., 3:].reshape(-1, 80).numpy())
    assert np.quantile(difference, 0.999) < 1e-5


def test_harmonics_of_a_higher_degree_are_refused():
    with pytest.raises(HilsplatError, match=r"K = 1, 4, 9 or 16(.|\n)*\(3, 25, 3\)"):
        render(random_gaussians(3, degree=4), camera())


# ---- edges ----------------------------------------------------------------------------------------


def test_an_empty_scene_is_transparent():
    nothing = rows(random_gaussians(1), slice(0, 0))
    seen = draw(nothing, camera(), 0, features=np.zeros((0, 4), np.float32))
    np.testing.assert_array_equal(seen.image, np.zeros((40, 56, 7)))
    assert seen.alpha.max() == 0
    assert pixel_weights(nothing, camera(), min_weight=0.0).shape == (40 * 56, 0)


def test_a_tiny_gaussian_is_as_wide_as_the_low_pass():
    # s = exp(-40): alpha = o exp(-r^2 / (2 * 0.3)); the pixel (16.5, 12.5) has r^2 = 0.5
    seen = draw(round_gaussian(0.8, math.exp(-40), 2.0), straight_camera(), 0)
    np.testing.assert_allclose(seen.alpha[12, 16], 0.8 * math.exp(-0.5 / 0.6), rtol=1e-5)
    gradients, _ = seen.gradients(np.ones_like(seen.image), np.ones_like(seen.alpha))
    assert all(np.isfinite(values).all() for values in gradients)


@pytest.mark.parametrize("log_scale", [20.0, 39.0, 40.0, 90.0, 1e6, (60.0, 60.0, math.log(0.01))])
def test_a_gaussian_far_wider_than_the_view_covers_it_evenly(log_scale):
    # s = exp(20) is 7e9 px wide here: alpha = o at every pixel, and wider ones cover no more. gsplat
    # overflows in float32. The last is a wall, 1000 units off the axis: 15000 px, much less than its width
    gaussians, is_wall = round_gaussian(0.8, 1.0, 2.0), isinstance(log_scale, tuple)
    gaussians.means[0, 0] = 1000.0 if is_wall else 0.0
    gaussians.log_scales[:] = log_scale
    seen = draw(gaussians, straight_camera(), 0)
    np.testing.assert_allclose(seen.alpha, 0.8, rtol=1e-6)
    gradients, _ = seen.gradients(np.zeros_like(seen.image), np.ones_like(seen.alpha))
    assert all(np.isfinite(values).all() for values in gradients)
    # d alpha / d logit = o (1 - o) at each of 24 x 32 pixels
    np.testing.assert_allclose(gradients.opacity_logits.item(), 24 * 32 * 0.8 * 0.2, rtol=1e-5)
    if not is_wall:  # nothing changes as the scale does
        np.testing.assert_allclose(gradients.log_scales, 0, atol=1e-12)


def test_a_needle_has_finite_gradients_that_agree_with_the_reference():
    # exp(2) along one axis, exp(-40) across: 110 px long and as narrow as the low-pass. Terms of the
    # exponent cancel to a thousandth of their size, which costs float32 three digits
    gaussians = round_gaussian(0.8, 1.0, 2.0)
    gaussians.log_scales[:] = [[2.0, -40.0, -40.0]]
    gaussians.quats[:] = [[0.9, 0.1, -0.2, 0.3]]
    seen = draw(gaussians, straight_camera(), 0)
    gradients, _ = seen.gradients(2 * seen.image, np.zeros_like(seen.alpha))
    parameters = leaves(gaussians)
    image, _ = render_reference(parameters, straight_camera(), 0)
    image.square().sum().backward()
    for name, leaf in zip(FIELDS, parameters, strict=True):
        expected = leaf.grad.numpy()
        error = np.linalg.norm(getattr(gradients, name) - expected)
        assert error <= 3e-3 * np.linalg.norm(expected) + 1e-6, name


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_parameters_that_are_not_finite_are_counted(field, value):
    gaussians = random_gaussians(10)
    getattr(gaussians, field)[2] = value
    gaussians.quats[5] = 0
    with pytest.raises(HilsplatError, match="2 of 10 Gaussians cannot be drawn"):
        draw(gaussians, camera(), 3)
    with pytest.raises(HilsplatError, match="2 of 10 Gaussians cannot be drawn"):
        pixel_weights(gaussians, camera(), min_weight=0.0)
