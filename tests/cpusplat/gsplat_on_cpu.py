"""gsplat's functions on the CPU: its own projection and harmonics in torch, and the loop of its kernel.

They replace gsplat's kernels on machines without a device, and in float64 they are the backends' reference.
"""

from typing import Any

import torch
from gsplat.cuda import _torch_impl as reference
from torch import Tensor

LEAST_ALPHA, MOST_ALPHA, LEAST_LIGHT = 1 / 255, 0.999, 1e-4  # constants of gsplat's CUDA kernels


def spherical_harmonics(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
    """As `gsplat.spherical_harmonics`."""
    return reference._spherical_harmonics(degree, directions, coefficients)


def quat_scale_to_covar_preci(quats: Tensor, scales: Tensor, *, compute_preci: bool) -> tuple[Tensor, None]:
    """As `gsplat.quat_scale_to_covar_preci`, without precision matrices."""
    assert not compute_preci
    return reference._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane, eps2d, **options
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """As `gsplat.rasterization` for one view, without tiles."""
    assert options["radius_clip"] == 0 and options["rasterize_mode"] == "classic"
    assert not options["packed"] and options["sh_degree"] is None
    covariances, _ = quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, _ = reference._fully_fused_projection(
        means, covariances, viewmats, Ks, width, height, eps2d=eps2d, near_plane=near_plane
    )
    notes = {"means2d": means2d, "depths": depths, "conics": conics, "radii": radii}
    order = torch.argsort(depths[0], stable=True)
    drawn = (radii[0] > 0).all(dim=-1)
    opacities = torch.where(drawn, opacities, 0.0)
    notes["opacities"] = opacities[None]
    notes["flatten_ids"] = order
    notes["isect_offsets"] = torch.zeros(1, 1, 1, dtype=torch.int32)
    # without boolean indices, because a test has tensors without values; the others may be infinite
    shown, curves = (torch.where(drawn[:, None], values[0], 1.0) for values in (means2d, conics))
    alpha = _alpha(shown[order], curves[order], opacities[order], width, height)
    weights = alpha * _light_before(alpha)
    image = torch.einsum("np,nc->pc", weights, colors[order]).reshape(1, height, width, -1)
    return image, weights.sum(dim=0).reshape(1, height, width, 1), notes


def rasterization_of_view(*arguments: Any) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """As `rasterization` with gsplat's defaults, for one viewmat and K."""
    *gaussians, viewmat, K, width, height = arguments
    options = {"radius_clip": 0, "rasterize_mode": "classic", "packed": False, "sh_degree": None}
    size = {"width": width, "height": height}
    return rasterization(*gaussians, viewmat[None], K[None], **size, near_plane=0.01, eps2d=0.3, **options)


def rasterize_to_indices_in_range(
    first, last, transmittances, means2d, conics, opacities, width, height, tile, isect_offsets, flatten_ids
) -> tuple[Tensor, Tensor, Tensor]:
    """As in gsplat: Gaussian and pixel of each blended pair, front to back within a pixel."""
    assert first == 0 and bool((transmittances == 1).all())
    order = flatten_ids
    alpha = _alpha(means2d[0, order], conics[0, order], opacities[0, order], width, height)
    row, pixel = torch.nonzero(alpha, as_tuple=True)  # rows are in order of depth
    return order[row], pixel, torch.zeros_like(pixel)


def _alpha(means2d: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int) -> Tensor:
    """Alpha of each Gaussian (front to back) at each pixel; 0 where the kernel skips it or has stopped."""
    rows, columns = (torch.arange(side, device=means2d.device) + 0.5 for side in (height, width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    dx = means2d[:, :1] - x.reshape(1, -1)
    dy = means2d[:, 1:] - y.reshape(1, -1)
    power = 0.5 * (conics[:, :1] * dx**2 + conics[:, 2:] * dy**2) + conics[:, 1:2] * dx * dy
    alpha = (opacities[:, None] * torch.exp(-power)).clamp_max(MOST_ALPHA)
    alpha = torch.where((power >= 0) & (alpha >= LEAST_ALPHA), alpha, 0.0)
    return torch.where(_light_before(alpha) * (1 - alpha) > LEAST_LIGHT, alpha, 0.0)


def _light_before(alpha: Tensor) -> Tensor:
    """Transmittance in front of each Gaussian at each pixel."""
    left = torch.cumprod(1 - alpha, dim=0)
    return torch.cat([torch.ones_like(left[:1]), left[:-1]])
