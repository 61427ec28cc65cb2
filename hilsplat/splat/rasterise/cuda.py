"""CUDA backend: gsplat (extra `gpu`) with the same functions and conventions as the CPU backend.

Tests run this backend on the CPU with gsplat's reference implementation in torch, and on a GPU if present.
CUDA sums are atomic, so gradients are reproducible only up to rounding.

gsplat works in float32 throughout: a Gaussian wider than about 1e9 px overflows.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.sparse import csr_matrix
from torch import Tensor

from cpusplat.blend import MAX_ALPHA
from cpusplat.project import LOW_PASS_PX2, NEAR
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise.drawn import Drawn, Gradients, refuse_broken, weight_matrix

DEVICE = "cuda"  # tests set this to `cpu` and use gsplat's reference implementation in torch

TILE = 16  # side of a gsplat tile, px
EVERYTHING = 2**31 - 1  # a number larger than any tile's batch index


def run_a_kernel() -> None:
    """Evaluate spherical harmonics of one Gaussian."""
    import gsplat

    gsplat.spherical_harmonics(0, torch.ones(1, 3, device=DEVICE), torch.ones(1, 1, 3, device=DEVICE))


def on_device(gaussians: Gaussians) -> dict[str, Tensor]:
    """Copy the fields of Gaussians to the device; raise an error if one cannot be drawn (`refuse_broken`)."""
    g = {name: torch.from_numpy(getattr(gaussians, name)).to(DEVICE) for name in FIELDS}
    broken = (g["quats"] == 0).all(dim=1)
    for values in g.values():
        broken |= ~values.isfinite().reshape(len(values), -1).all(dim=1)
    refuse_broken(int(broken.sum()), len(gaussians))
    return g


def blend(
    g: dict[str, Tensor], camera: Camera, channels: Float[Tensor, "N C"]
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"], dict[str, Any]]:
    """Blend channels of Gaussians on the device; return premultiplied image, alpha and intermediates."""
    import gsplat

    height, width = camera.size_hw
    pose, K = (
        torch.tensor(each, dtype=torch.float32, device=DEVICE) for each in (camera.cam_from_world, camera.K)
    )
    image, alpha, notes = gsplat.rasterization(
        g["means"],
        g["quats"],
        g["log_scales"].exp(),
        g["opacity_logits"].sigmoid(),
        channels,
        pose[None],
        K[None],
        width,
        height,
        near_plane=NEAR,
        radius_clip=0.0,
        eps2d=LOW_PASS_PX2,
        sh_degree=None,
        packed=False,
        tile_size=TILE,
        render_mode="RGB",
        rasterize_mode="classic",
    )
    return image[0], alpha[0, ..., 0], notes


def pixel_weights(gaussians: Gaussians, camera: Camera, min_weight: float) -> csr_matrix:
    """Return the blending weight of each Gaussian at each pixel; see `api.pixel_weights`.

    gsplat lists the Gaussians blended at each pixel; their weights are computed from the projected
    Gaussians. The list takes about 60 bytes per entry on the device (some 40 entries per pixel).
    """
    import gsplat

    height, width = camera.size_hw
    with torch.no_grad():
        g = on_device(gaussians)
        _, _, notes = blend(g, camera, torch.zeros(len(gaussians), 1, device=DEVICE))
        who, pixel, _ = gsplat.rasterize_to_indices_in_range(
            0,
            EVERYTHING,
            torch.ones(1, height, width, device=DEVICE),
            notes["means2d"],
            notes["conics"],
            notes["opacities"],
            width,
            height,
            TILE,
            notes["isect_offsets"],
            notes["flatten_ids"],
        )
        # sort by pixel and keep the order within a pixel, front to back
        pixel, order = torch.sort(pixel, stable=True)
        who = who[order]
        dx = notes["means2d"][0, who, 0] - (pixel % width + 0.5)
        dy = notes["means2d"][0, who, 1] - (pixel // width + 0.5)
        conic = notes["conics"][0, who]
        power = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
        alpha = (g["opacity_logits"].sigmoid()[who] * torch.exp(-power)).clamp_max(MAX_ALPHA).double()
        count = torch.bincount(pixel, minlength=height * width)
        weight = alpha * _light_before(alpha, count)
        kept = (weight >= min_weight) & (weight > 0)
        pixel, who, weight = pixel[kept], who[kept], weight[kept]
        # sorting columns on the host would take longer than everything else
        order = torch.argsort(pixel * len(gaussians) + who)
        row_start = np.zeros(height * width + 1, np.int64)
        row_start[1:] = torch.bincount(pixel, minlength=height * width).cumsum(0).cpu().numpy()
        columns, weights = who[order].int().cpu().numpy(), weight[order].float().cpu().numpy()
    return weight_matrix(weights, columns, row_start, len(gaussians))


def _light_before(alpha: Float[Tensor, " E"], count: Tensor) -> Float[Tensor, " E"]:
    """Return the product of 1 - alpha over the preceding entries, within runs of `count` entries."""
    log_left = torch.log1p(-alpha)
    log_before = torch.cumsum(log_left, dim=0) - log_left
    begin = (torch.cumsum(count, dim=0) - count)[count > 0]
    return torch.exp(log_before - log_before[begin].repeat_interleave(count[count > 0]))


def draw(
    gaussians: Gaussians, camera: Camera, degree: int, features: Float32[np.ndarray, "N D"] | None
) -> Drawn:
    """Draw image and alpha, and compute gradients on demand; see `api.draw`."""
    import gsplat

    features = np.zeros((len(gaussians), 0), np.float32) if features is None else features
    g = {name: values.requires_grad_() for name, values in on_device(gaussians).items()}
    blended = torch.from_numpy(features).to(DEVICE).requires_grad_()
    centre = torch.tensor(camera.centre, dtype=torch.float32, device=DEVICE)
    colours = (gsplat.spherical_harmonics(degree, g["means"] - centre, g["sh"]) + 0.5).clamp_min(0.0)
    image, alpha, notes = blend(g, camera, torch.cat([colours, blended], dim=1))

    def gradients(grad_image: np.ndarray, grad_alpha: np.ndarray) -> Gradients:
        grads = torch.autograd.grad(
            [image, alpha],
            [*g.values(), blended, notes["means2d"]],
            [torch.from_numpy(np.ascontiguousarray(grad)).to(DEVICE) for grad in (grad_image, grad_alpha)],
        )
        *by_field, by_features, by_mean_px = (grad.cpu().numpy() for grad in grads)
        by_name = dict(zip(FIELDS, by_field, strict=True))
        return Gradients(**by_name, features=by_features, means_px=by_mean_px[0])

    drawn = (notes["radii"][0] > 0).all(dim=-1).cpu().numpy()
    return Drawn(image.detach().cpu().numpy(), alpha.detach().cpu().numpy(), drawn, gradients)
