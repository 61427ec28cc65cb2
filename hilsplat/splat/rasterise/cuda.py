"""The CUDA backend: gsplat (extra `gpu`) behind the functions and conventions of the CPU backend.

Written against the public interface of gsplat 1.5 and its CUDA sources. It has not been run on a
device yet: the tests of the rasteriser cover it if torch finds one. Sums on CUDA are atomic, so
gradients repeat to rounding, not to the bit.

gsplat works in float32 throughout: a Gaussian wider than about 1e9 px overflows there.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_matrix
from torch import Tensor

from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.blend import MAX_ALPHA
from hilsplat.splat.rasterise.cpu import Drawn, Gradients, Parameters, refuse_broken
from hilsplat.splat.rasterise.project import LOW_PASS_PX2, NEAR

TILE = 16
"""Side of gsplat's tiles, px."""
EVERYTHING = 2**31 - 1
"""Past the last batch of any tile."""


def _on_device(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians as float32 on the device; gradients flow back."""
    g = gaussians
    tensors = (g.means, g.log_scales, g.quats, g.opacity_logits, g.sh)
    g = Gaussians(*(tensor.to("cuda", torch.float32) for tensor in tensors))
    numbers = torch.cat(
        [g.means, g.log_scales, g.quats, g.opacity_logits[:, None], g.sh.flatten(1)], dim=1
    ).detach()
    broken = ~numbers.isfinite().all(dim=1) | (g.quats.detach() == 0).all(dim=1)
    refuse_broken(int(broken.sum()), len(g))
    return g


def blend(
    gaussians: Gaussians, camera: Camera, channels: Float[Tensor, "N C"]
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"], dict[str, Any]]:
    """Blend channels of Gaussians on the device: premultiplied image, alpha, intermediate results."""
    import gsplat

    height, width = camera.size_hw
    image, alpha, notes = gsplat.rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        channels,
        torch.tensor(camera.cam_from_world, dtype=torch.float32, device="cuda")[None],
        torch.tensor(camera.K, dtype=torch.float32, device="cuda")[None],
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


def colours(gaussians: Gaussians, camera: Camera, degree: int) -> Float[Tensor, "N 3"]:
    """RGB in a view: max(0, 0.5 + spherical harmonics), on the device."""
    import gsplat

    centre = torch.tensor(camera.centre, dtype=torch.float32, device="cuda")
    return (gsplat.spherical_harmonics(degree, gaussians.means - centre, gaussians.sh) + 0.5).clamp_min(0.0)


def render_channels(
    gaussians: Gaussians, camera: Camera, degree: int, features: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Premultiplied RGB (+ features) and alpha, on the Gaussians' device."""
    home = gaussians.means.device
    if len(gaussians) == 0:
        width = 3 + (features.shape[1] if features is not None else 0)
        nothing = torch.zeros(*camera.size_hw, width + 1, device=home)
        return nothing[..., :-1], nothing[..., -1]
    g = _on_device(gaussians)
    channels = colours(g, camera, degree)
    if features is not None:
        channels = torch.cat([channels, features.to("cuda", torch.float32)], dim=1)
    image, alpha, _ = blend(g, camera, channels)
    return image.to(home), alpha.to(home)


def pixel_weights(gaussians: Gaussians, camera: Camera, min_weight: float) -> csr_matrix:
    """Blending weights of each Gaussian at each pixel, as `api.pixel_weights` returns them.

    gsplat lists which Gaussians are blended at each pixel; the weights follow from the projected
    Gaussians. The list takes about 60 bytes per entry on the device (some 40 entries per pixel).
    """
    import gsplat

    height, width = camera.size_hw
    shape = (height * width, len(gaussians))
    if len(gaussians) == 0:
        return csr_matrix(shape, dtype=np.float32)
    with torch.no_grad():
        g = _on_device(gaussians)
        _, _, notes = blend(g, camera, torch.zeros(len(g), 1, device="cuda"))
        who, pixel, _ = gsplat.rasterize_to_indices_in_range(
            0,
            EVERYTHING,
            torch.ones(1, height, width, device="cuda"),
            notes["means2d"],
            notes["conics"],
            notes["opacities"],
            width,
            height,
            TILE,
            notes["isect_offsets"],
            notes["flatten_ids"],
        )
        # by pixel; the order within a pixel, front to back, is kept
        pixel, order = torch.sort(pixel, stable=True)
        who = who[order]
        dx = notes["means2d"][0, who, 0] - (pixel % width + 0.5)
        dy = notes["means2d"][0, who, 1] - (pixel // width + 0.5)
        conic = notes["conics"][0, who]
        power = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
        alpha = (g.opacities[who] * torch.exp(-power)).clamp_max(MAX_ALPHA).double()
        count = torch.bincount(pixel, minlength=height * width)
        weight = alpha * _light_before(alpha, count)
        kept = (weight >= min_weight) & (weight > 0)
        row_start = np.zeros(height * width + 1, np.int64)
        row_start[1:] = torch.bincount(pixel[kept], minlength=height * width).cumsum(0).cpu().numpy()
        columns, weights = who[kept].int().cpu().numpy(), weight[kept].float().cpu().numpy()
    if row_start[-1] < np.iinfo(np.int32).max:
        row_start = row_start.astype(np.int32)
    matrix = csr_matrix((weights, columns, row_start), shape=shape, copy=False)
    matrix.sort_indices()
    return matrix


def _light_before(alpha: Float[Tensor, " E"], count: Tensor) -> Float[Tensor, " E"]:
    """Product of 1 - alpha over the entries before, within runs of `count` entries."""
    log_left = torch.log1p(-alpha)
    log_before = torch.cumsum(log_left, dim=0) - log_left
    begin = (torch.cumsum(count, dim=0) - count)[count > 0]
    return torch.exp(log_before - log_before[begin].repeat_interleave(count[count > 0]))


def draw(parameters: Parameters, camera: Camera, degree: int) -> Drawn:
    """One view of a fit: image, alpha, and the gradients on demand (see the CPU backend's `draw`)."""
    fields = ("means", "log_scales", "quats", "opacity_logits", "sh")
    leaves = [torch.from_numpy(getattr(parameters, name)).cuda().requires_grad_() for name in fields]
    g = _on_device(Gaussians(*leaves))
    image, alpha, notes = blend(g, camera, colours(g, camera, degree))

    def gradients(grad_image: np.ndarray, grad_alpha: np.ndarray) -> Gradients:
        grads = torch.autograd.grad(
            [image, alpha],
            [*leaves, notes["means2d"]],
            [torch.from_numpy(np.ascontiguousarray(grad)).cuda() for grad in (grad_image, grad_alpha)],
        )
        *by_field, by_mean_px = (grad.cpu().numpy() for grad in grads)
        return Gradients(
            **dict(zip(fields, by_field, strict=True)),
            features=np.zeros((len(leaves[0]), 0), np.float32),
            means_px=by_mean_px[0],
        )

    drawn = (notes["radii"][0] > 0).all(dim=-1).cpu().numpy()
    return Drawn(image.detach().cpu().numpy(), alpha.detach().cpu().numpy(), drawn, gradients)
