"""The slow reference: against the closed form, then its gradients against finite differences."""

import numpy as np
import pytest
import torch

from hilsplat.splat.gaussians import FIELDS, Gaussians
from tests.unit.splat.rasterise_scenes import (
    camera,
    leaves,
    random_gaussians,
    round_gaussian,
    straight_camera,
)
from tests.unit.splat.reference import Tensors, render_reference


@pytest.mark.parametrize(("opacity", "scale", "depth"), [(0.8, 0.2, 2.0), (0.3, 0.05, 1.0), (0.99, 1.0, 5.0)])
def test_round_gaussian_has_the_closed_form(opacity, scale, depth):
    # alpha = o exp(-r^2 / (2 ((f s / z)^2 + 0.3))), r px from the principal point (16, 12)
    image, alpha, weights = render_reference(round_gaussian(opacity, scale, depth), straight_camera(), 0)
    rows, columns = np.mgrid[:24, :32] + 0.5
    r2 = (columns - 16) ** 2 + (rows - 12) ** 2
    expected = opacity * np.exp(-r2 / (2 * ((30 * scale / depth) ** 2 + 0.3)))
    expected[expected < 1 / 255] = 0
    # the parameters are float32
    np.testing.assert_allclose(alpha.numpy(), expected, rtol=2e-6, atol=1e-7)
    np.testing.assert_allclose(image.numpy(), expected[..., None].repeat(3, axis=2), rtol=2e-6, atol=1e-7)
    assert torch.equal(weights[0], alpha)


def test_two_gaussians_blend_front_to_back():
    # both 0.5 everywhere (wide): the near one, second in the rows, takes 0.5, the far one 0.25
    far, near = round_gaussian(0.5, 100.0, 4.0), round_gaussian(0.5, 100.0, 2.0)
    both = Gaussians(*(np.concatenate([getattr(g, name) for g in (far, near)]) for name in FIELDS))
    _, alpha, weights = render_reference(both, straight_camera(), 0)
    np.testing.assert_allclose(weights[:, 12, 16].numpy(), [0.25, 0.5], atol=1e-6)
    np.testing.assert_allclose(alpha[12, 16].item(), 0.75, atol=1e-6)


@pytest.mark.parametrize("field", [*FIELDS, "features"])
def test_gradient_agrees_with_finite_differences(field):
    # alpha stays between its cut at 1/255 and its cap in all pixels, so everything is smooth
    view = camera(5, 6, focal=6.0)
    cam = torch.tensor([[0.1, -0.2, 1.5], [-0.3, 0.1, 2.0], [0.2, 0.3, 2.5]], dtype=torch.float64)
    pose = torch.from_numpy(view.cam_from_world)
    generator = torch.Generator().manual_seed(0)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    values = {
        "means": (cam - pose[:3, 3]) @ pose[:3, :3],
        "log_scales": 0.3 + 0.2 * noise(3, 3),
        "quats": noise(3, 4),
        "opacity_logits": 0.5 * noise(3),
        "sh": 0.2 * noise(3, 16, 3),
        "features": noise(3, 2),
    }

    def shown(changed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        now = {**values, field: changed}
        gaussians = Tensors(*(now[name] for name in FIELDS))
        image, alpha, weights = render_reference(gaussians, view, 3, now["features"])
        assert (weights > 0.01).all()
        return image, alpha

    assert torch.autograd.gradcheck(shown, values[field].clone().requires_grad_())


def test_every_parameter_has_a_gradient():
    parameters = leaves(random_gaussians(20))
    features = torch.ones(20, 2, dtype=torch.float64, requires_grad=True)
    image, _, _ = render_reference(Tensors(*parameters), camera(), 3, features)
    image.square().sum().backward()
    for name, leaf in zip((*FIELDS, "features"), [*parameters, features], strict=True):
        assert leaf.grad.abs().max() > 0, name
