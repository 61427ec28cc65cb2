"""The CPU rasteriser against a closed form, a slow reference, and itself on other thread counts."""

import math

import numpy as np
import pytest
import torch

from hilsplat.base.errors import HilsplatError
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.api import pixel_weights, render, render_features
from hilsplat.splat.rasterise.reference import render_reference

FIELDS = ("means", "log_scales", "quats", "opacity_logits", "sh")


def camera(height: int = 40, width: int = 56, focal: float = 50.0) -> Camera:
    """A turned and shifted camera, so that every entry of the pose matters."""
    a, b = 0.3, -0.2
    turn = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    tilt = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    pose = np.eye(4)
    pose[:3, :3] = tilt @ turn
    pose[:3, 3] = (0.1, -0.2, 0.3)
    K = np.array([[focal, 0, width / 2 + 1.5], [0, focal * 1.1, height / 2 - 2.0], [0, 0, 1]])
    return Camera("view.png", pose, K, (height, width))


def random_gaussians(n: int, seed: int = 0, degree: int = 3) -> Gaussians:
    """Gaussians around the view's frustum: in front, aside and a few behind the camera."""
    rng = np.random.default_rng(seed)
    cam = np.stack([rng.uniform(-2, 2, n), rng.uniform(-1.6, 1.6, n), rng.uniform(-0.3, 4, n)], axis=1)
    pose = camera().cam_from_world
    arrays = (
        (cam - pose[:3, 3]) @ pose[:3, :3],
        np.log(rng.uniform(0.02, 0.25, (n, 3))),
        rng.normal(size=(n, 4)),
        rng.normal(size=n) * 2,
        rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.4,
    )
    return Gaussians(*(torch.tensor(values, dtype=torch.float32) for values in arrays))


def round_gaussian(opacity: float, scale: float, depth: float) -> Gaussians:
    """One round white Gaussian on the optical axis of a camera at the origin."""
    return Gaussians(
        torch.tensor([[0.0, 0.0, depth]]),
        torch.full((1, 3), math.log(scale)),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([math.log(opacity / (1 - opacity))]),
        torch.full((1, 1, 3), 0.5 / 0.28209479177387814),
    )


def test_round_gaussian_has_the_closed_form():
    # alpha = o exp(-r^2 / (2 ((f s / z)^2 + 0.3))), r px from the principal point (16, 12)
    straight = Camera("v.png", np.eye(4), np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), (24, 32))
    out = render(round_gaussian(0.8, 0.2, 2.0), straight, depth=True)
    rows, columns = np.mgrid[:24, :32] + 0.5
    r2 = (columns - 16) ** 2 + (rows - 12) ** 2
    expected = 0.8 * np.exp(-r2 / (2 * ((30 * 0.2 / 2) ** 2 + 0.3)))
    expected[expected < 1 / 255] = 0
    np.testing.assert_allclose(out.alpha.numpy(), expected, atol=2e-6)
    np.testing.assert_allclose(out.color.numpy(), expected[..., None].repeat(3, axis=2), atol=2e-6)
    np.testing.assert_allclose(out.depth.numpy()[expected > 0], 2.0, rtol=1e-6)


def test_background_shows_through():
    straight = Camera("v.png", np.eye(4), np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), (24, 32))
    out = render(round_gaussian(0.5, 5.0, 2.0), straight, background=(0.0, 1.0, 0.0))
    # in the middle alpha is 0.5: white over green
    np.testing.assert_allclose(out.color[12, 16].numpy(), [0.5, 1.0, 0.5], atol=1e-3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_image_agrees_with_reference(degree):
    gaussians, view = random_gaussians(60, degree=degree), camera()
    features = torch.randn(60, 5, generator=torch.Generator().manual_seed(1))
    out = render(gaussians, view, features=features, sh_degree=degree)
    image, alpha, _ = render_reference(gaussians, view, degree, features)
    assert alpha.max() > 0.9
    # float32 against float64; at the cliffs 1/255 and 1e-4 a pixel may differ by as much
    got = torch.cat([out.color, out.features], dim=2)
    assert torch.quantile((got - image).abs(), 0.99) < 1e-5
    assert (got - image).abs().max() < 2e-2
    assert (out.alpha - alpha).abs().max() < 5e-3


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("num_features", [0, 4])
def test_gradients_agree_with_autograd_of_reference(degree, num_features):
    view = camera()
    base = random_gaussians(60, seed=3, degree=degree)
    generator = torch.Generator().manual_seed(2)
    features = torch.randn(60, num_features, generator=generator) if num_features else None
    weight = torch.randn(*view.size_hw, 3 + num_features, generator=generator)
    alpha_weight = torch.randn(*view.size_hw, generator=generator)

    def gradients(fast: bool) -> list[torch.Tensor]:
        leaves = [getattr(base, name).clone().requires_grad_() for name in FIELDS]
        extra = features.clone().requires_grad_() if features is not None else None
        if fast:
            out = render(Gaussians(*leaves), view, features=extra, background=(0.2, 0.4, 0.6))
            image, alpha = out.color, out.alpha
            if extra is not None:
                image = torch.cat([image, out.features], dim=2)
        else:
            image, alpha, _ = render_reference(Gaussians(*leaves), view, degree, extra)
            behind = torch.tensor([0.2, 0.4, 0.6, *[0.0] * num_features], dtype=torch.float64)
            image = image + (1 - alpha)[..., None] * behind
        ((image * weight).sum() + (alpha * alpha_weight).sum()).backward()
        return [leaf.grad for leaf in [*leaves, *([extra] if extra is not None else [])]]

    for name, got, expected in zip((*FIELDS, "features"), gradients(True), gradients(False), strict=False):
        error = (got - expected).norm() / expected.norm()
        assert error < 2e-4, f"{name}: relative error {error:.1e}"


def test_any_number_of_threads_gives_the_same_bytes():
    base, view = random_gaussians(300, seed=5), camera(70, 90)

    def everything(threads: int) -> list[torch.Tensor]:
        leaves = [getattr(base, name).clone().requires_grad_() for name in FIELDS]
        out = render(Gaussians(*leaves), view, threads=threads)
        (out.color.square().sum() + out.alpha.sum()).backward()
        matrix = pixel_weights(base, view, min_weight=1e-3, threads=threads)
        sparse = [torch.from_numpy(values) for values in (matrix.data, matrix.indices, matrix.indptr)]
        return [out.color.detach(), out.alpha.detach(), *(leaf.grad for leaf in leaves), *sparse]

    for one, several in zip(everything(1), everything(3), strict=True):
        assert torch.equal(one, several)


def test_weights_sum_to_alpha_and_blend_to_features():
    gaussians, view = random_gaussians(80, seed=7), camera()
    matrix = pixel_weights(gaussians, view, min_weight=0.0)
    features = np.random.default_rng(0).normal(size=(80, 40)).astype(np.float32)
    blended, alpha = render_features(gaussians, view, features, threads=2)
    np.testing.assert_allclose(np.asarray(matrix.sum(axis=1)).reshape(view.size_hw), alpha, atol=1e-6)
    np.testing.assert_allclose((matrix @ features).reshape(blended.shape), blended, atol=2e-5)
    assert matrix.has_sorted_indices
    assert all(np.all(np.diff(matrix[row].indices) > 0) for row in range(0, matrix.shape[0], 37))
    _, _, weights = render_reference(gaussians, view, 0)
    difference = np.abs(matrix.toarray() - weights.reshape(80, -1).T.numpy())
    assert np.quantile(difference, 0.999) < 1e-5


def test_small_weights_are_dropped():
    matrix = pixel_weights(random_gaussians(80, seed=7), camera(), min_weight=0.01)
    assert matrix.data.min() >= 0.01
    assert matrix.dtype == np.float32


def test_empty_scene_shows_the_background():
    nothing = Gaussians(*(getattr(random_gaussians(1), name)[:0] for name in FIELDS))
    out = render(nothing, camera(), background=(0.1, 0.2, 0.3))
    assert torch.equal(out.color, torch.tensor([0.1, 0.2, 0.3]).expand(40, 56, 3))
    assert out.alpha.max() == 0
    assert pixel_weights(nothing, camera(), min_weight=0.0).nnz == 0


def test_gaussians_behind_the_camera_are_not_drawn():
    straight = Camera("v.png", np.eye(4), np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), (24, 32))
    behind = round_gaussian(0.8, 0.2, -2.0)
    behind.means.requires_grad_()
    out = render(behind, straight)
    out.color.sum().backward()
    assert out.alpha.max() == 0
    assert torch.equal(behind.means.grad, torch.zeros(1, 3))


def test_broken_parameters_are_counted():
    gaussians = random_gaussians(10)
    gaussians.means[3, 1] = math.nan
    gaussians.quats[5] = 0
    gaussians.sh[7, 2, 0] = math.inf
    with pytest.raises(HilsplatError, match="3 of 10 Gaussians cannot be drawn"):
        render(gaussians, camera())


def test_too_high_a_degree_is_refused():
    with pytest.raises(HilsplatError, match="degree 2"):
        render(random_gaussians(3, degree=1), camera(), sh_degree=2)
