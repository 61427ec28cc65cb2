"""CUDA backend: gsplat (extra `gpu`) with the functions and conventions of the CPU backend.

Tests run it on the CPU with gsplat's reference implementation in torch, and on a device if there is one.
CUDA sums are atomic, so gradients are reproducible only up to rounding.

gsplat works in float32 throughout: a Gaussian wider than about 1e9 px overflows.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.sparse import csr_matrix
from torch import Tensor

from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise.blend import MAX_ALPHA
from hilsplat.splat.rasterise.cpu import Drawn, Gradients, refuse_broken
from hilsplat.splat.rasterise.project import LOW_PASS_PX2, NEAR

DEVICE = "cuda"
"""Tests set this to `cpu`, with gsplat's reference implementation in torch."""

TILE = 16
"""Side of a gsplat tile, px."""
EVERYTHING = 2**31 - 1
"""A number beyond the last batch of any tile."""


class OnDevice(NamedTuple):
    """Gaussians as float32 tensors on the device, with the fields of `Gaussians`."""

    means: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    opacity_logits: Float[Tensor, " N"]
    sh: Float[Tensor, "N K 3"]

    @staticmethod
    def of(gaussians: Gaussians) -> "OnDevice":
        """Copy Gaussians to the device.

        Raises:
            HilsplatError: if parameters are not finite, or quaternions are zero.
        """
        g = OnDevice(*(torch.from_numpy(getattr(gaussians, name)).to(DEVICE) for name in FIELDS))
        broken = (g.quats == 0).all(dim=1)
        for values in g:
            broken |= ~values.isfinite().reshape(len(values), -1).all(dim=1)
        refuse_broken(int(broken.sum()), len(gaussians))
        return g


def blend(
    g: OnDevice, camera: Camera, channels: Float[Tensor, "N C"]
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"], dict[str, Any]]:
    """Blend channels of Gaussians on the device into premultiplied image, alpha and intermediate results."""
    import gsplat

    height, width = camera.size_hw
    image, alpha, notes = gsplat.rasterization(
        g.means,
        g.quats,
        g.log_scales.exp(),
        g.opacity_logits.sigmoid(),
        channels,
        torch.tensor(camera.cam_from_world, dtype=torch.float32, device=DEVICE)[None],
        torch.tensor(camera.K, dtype=torch.float32, device=DEVICE)[None],
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


def colours(g: OnDevice, camera: Camera, degree: int) -> Float[Tensor, "N 3"]:
    """Return the colours in a view, max(0, 0.5 + spherical harmonics), on the device."""
    import gsplat

    centre = torch.tensor(camera.centre, dtype=torch.float32, device=DEVICE)
    return (gsplat.spherical_harmonics(degree, g.means - centre, g.sh) + 0.5).clamp_min(0.0)


def pixel_weights(gaussians: Gaussians, camera: Camera, min_weight: float) -> csr_matrix:
    """Return the blending weight of each Gaussian at each pixel, like `api.pixel_weights`.

    gsplat lists the Gaussians blended at each pixel; their weights are computed from the projected
    Gaussians. The list takes about 60 bytes per entry on the device (some 40 entries per pixel).
    """
    import gsplat

    height, width = camera.size_hw
    shape = (height * width, len(gaussians))
    if len(gaussians) == 0:
        return csr_matrix(shape, dtype=np.float32)
    with torch.no_grad():
        g = OnDevice.of(gaussians)
        _, _, notes = blend(g, camera, torch.zeros(len(g.means), 1, device=DEVICE))
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
        alpha = (g.opacity_logits.sigmoid()[who] * torch.exp(-power)).clamp_max(MAX_ALPHA).double()
        count = torch.bincount(pixel, minlength=height * width)
        weight = alpha * _light_before(alpha, count)
        kept = (weight >= min_weight) & (weight > 0)
        pixel, who, weight = pixel[kept], who[kept], weight[kept]
        # sorting columns on the host would take longer than everything else
        order = torch.argsort(pixel * len(gaussians) + who)
        row_start = np.zeros(height * width + 1, np.int64)
        row_start[1:] = torch.bincount(pixel, minlength=height * width).cumsum(0).cpu().numpy()
        columns, weights = who[order].int().cpu().numpy(), weight[order].float().cpu().numpy()
    if row_start[-1] < np.iinfo(np.int32).max:
        row_start = row_start.astype(np.int32)
    matrix = csr_matrix((weights, columns, row_start), shape=shape, copy=False)
    matrix.has_sorted_indices = True
    return matrix


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
    width = 0 if features is None else features.shape[1]
    if len(gaussians) == 0:
        return _nothing(gaussians, camera, width)
    leaves = [values.requires_grad_() for values in OnDevice.of(gaussians)]
    g = OnDevice(*leaves)
    blended = torch.from_numpy(
        np.zeros((len(gaussians), 0), np.float32) if features is None else features
    ).to(DEVICE)
    blended.requires_grad_()
    image, alpha, notes = blend(g, camera, torch.cat([colours(g, camera, degree), blended], dim=1))

    def gradients(grad_image: np.ndarray, grad_alpha: np.ndarray) -> Gradients:
        grads = torch.autograd.grad(
            [image, alpha],
            [*leaves, blended, notes["means2d"]],
            [torch.from_numpy(np.ascontiguousarray(grad)).to(DEVICE) for grad in (grad_image, grad_alpha)],
        )
        *by_field, by_features, by_mean_px = (grad.cpu().numpy() for grad in grads)
        by_name = dict(zip(FIELDS, by_field, strict=True))
        return Gradients(**by_name, features=by_features, means_px=by_mean_px[0])

    drawn = (notes["radii"][0] > 0).all(dim=-1).cpu().numpy()
    return Drawn(image.detach().cpu().numpy(), alpha.detach().cpu().numpy(), drawn, gradients)


def _nothing(gaussians: Gaussians, camera: Camera, width: int) -> Drawn:
    """Return a view without Gaussians, which gsplat does not support."""

    def gradients(grad_image: np.ndarray, grad_alpha: np.ndarray) -> Gradients:
        by_name = {name: np.zeros_like(getattr(gaussians, name)) for name in FIELDS}
        return Gradients(
            **by_name, features=np.zeros((0, width), np.float32), means_px=np.zeros((0, 2), np.float32)
        )

    image = np.zeros((*camera.size_hw, 3 + width), np.float32)
    return Drawn(image, np.zeros(camera.size_hw, np.float32), np.zeros(0, np.bool_), gradients)
