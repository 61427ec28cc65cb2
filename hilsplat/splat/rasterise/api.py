"""Rendering Gaussians into a view: images with gradients, feature maps, sparse weights."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_matrix
from torch import Tensor

from hilsplat.base.errors import HilsplatError
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.cpu import (
    Parameters,
    Projected,
    blend_forward,
    blend_gradients,
    project_gaussians,
    sparse_weights,
)

CHANNELS_PER_PASS = 32
"""Feature channels blended in one pass; more would leave the first-level cache."""


@dataclass(frozen=True)
class Rendering:
    """What one view shows.

    Attributes:
        color: RGB over the background.
        alpha: coverage in [0, 1], the sum of the blending weights.
        features: blended features, premultiplied (divide by alpha for their average), or None.
        depth: average depth of what is seen, scene units; 0 where alpha is 0. No gradient. None
            unless asked for.
    """

    color: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    features: Float[Tensor, "H W D"] | None = None
    depth: Float[Tensor, "H W"] | None = None


def to_parameters(gaussians: Gaussians) -> Parameters:
    """Gaussians as contiguous float32 arrays (shared memory where they are so already)."""
    tensors = (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh)
    return Parameters(*(_to_array(tensor) for tensor in tensors))


def _to_array(values: Tensor | np.ndarray) -> np.ndarray:
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    return np.ascontiguousarray(values, dtype=np.float32)


def _checked_degree(gaussians: Gaussians, sh_degree: int | None) -> int:
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    if not 0 <= degree <= min(gaussians.sh_degree, 3):
        raise HilsplatError(
            f"spherical harmonics of degree {degree} were asked for",
            expected=f"0 to {gaussians.sh_degree}, the degree of these Gaussians, and at most 3",
        )
    return degree


class _Render(torch.autograd.Function):
    """Premultiplied RGB + feature channels and alpha, with the CPU backend's own gradients."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Any:
        *tensors, features, camera, degree, threads = arguments
        parameters = Parameters(*(_to_array(tensor) for tensor in tensors))
        view = project_gaussians(parameters, camera, degree, threads)
        channels = view.colours
        if features is not None:
            channels = np.concatenate([channels, _to_array(features)], axis=1)
        image, alpha = blend_forward(view, channels, threads)
        ctx.replay = (parameters, view, channels, image, alpha, threads, features is not None)
        ctx.dtypes = [tensor.dtype for tensor in tensors]
        depths = torch.from_numpy(view.geometry[:, 6])
        ctx.mark_non_differentiable(depths)
        return torch.from_numpy(image), torch.from_numpy(alpha), depths

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        parameters, view, channels, image, alpha, threads, has_features = ctx.replay
        grad_image, grad_alpha = (_to_array(grad) for grad in grads[:2])
        g = blend_gradients(parameters, view, channels, image, alpha, grad_image, grad_alpha, threads)
        arrays = (g.means, g.log_scales, g.quats, g.opacity_logits, g.sh)
        out = [torch.from_numpy(a).to(dtype) for a, dtype in zip(arrays, ctx.dtypes, strict=True)]
        return *out, torch.from_numpy(g.features) if has_features else None, None, None, None


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    features: Float[Tensor, "N D"] | None = None,
    sh_degree: int | None = None,
    threads: int = 1,
    depth: bool = False,
) -> Rendering:
    """Render a view; differentiable in all parameters of the Gaussians and in `features`.

    Conventions of gsplat: pixel centres at +0.5, 0.3 px^2 low-pass, alpha cut at 1/255 and clipped
    at 0.999, blending stops before transmittance falls to 1e-4, near plane 0.01. Gaussians behind
    the camera contribute nothing and get zero gradient; without any Gaussian the background shows.
    Gradients are first-order only and do not reach the camera.

    Args:
        features: further channels to blend; they are not affected by the background.
        sh_degree: degree of the spherical harmonics to use; all of them by default.
        threads: CPU threads; the result is the same bytes for any number.
        depth: also return the average depth.

    Raises:
        HilsplatError: parameters that are not finite, or zero quaternions.
    """
    degree = _checked_degree(gaussians, sh_degree)
    g = gaussians
    image, alpha, depths = _Render.apply(
        g.means, g.log_scales, g.quats, g.opacity_logits, g.sh, features, camera, degree, threads
    )
    behind = torch.tensor(background, dtype=image.dtype)
    color = image[..., :3] + (1.0 - alpha)[..., None] * behind
    depth_map = None
    if depth:
        with torch.no_grad():
            summed, covered = render_features(gaussians, camera, depths[:, None], threads=threads)
            depth_map = torch.from_numpy(
                np.divide(summed[..., 0], covered, out=np.zeros_like(covered), where=covered > 0)
            )
    return Rendering(color, alpha, image[..., 3:] if features is not None else None, depth_map)


def render_features(
    gaussians: Gaussians,
    camera: Camera,
    features: Float[np.ndarray, "N D"] | Float[Tensor, "N D"],
    *,
    threads: int = 1,
) -> tuple[Float[np.ndarray, "H W D"], Float[np.ndarray, "H W"]]:
    """Blend any number of feature channels into a view, without gradients.

    Returns:
        The premultiplied feature map and alpha; divide by alpha for the average feature.

    Raises:
        HilsplatError: rows of `features` do not fit, or parameters cannot be drawn.
    """
    values = _to_array(features)
    if len(values) != len(gaussians):
        raise HilsplatError(
            "features do not fit the Gaussians",
            expected=f"{len(gaussians)} rows",
            found=f"{len(values)} rows",
        )
    view = _project(gaussians, camera, threads)
    out = np.empty((*camera.size_hw, values.shape[1]), np.float32)
    _, alpha = blend_forward(view, np.empty((len(values), 0), np.float32), threads)
    for begin in range(0, values.shape[1], CHANNELS_PER_PASS):
        some = np.ascontiguousarray(values[:, begin : begin + CHANNELS_PER_PASS])
        out[..., begin : begin + CHANNELS_PER_PASS], _ = blend_forward(view, some, threads)
    return out, alpha


def pixel_weights(gaussians: Gaussians, camera: Camera, *, min_weight: float, threads: int = 1) -> csr_matrix:
    """Blending weight alpha_i T_i of each Gaussian at each pixel, as a sparse matrix.

    Args:
        min_weight: weights below are dropped; 0 keeps all that are drawn.

    Returns:
        float32 matrix (H W, N), rows row-major pixels, columns sorted. With min_weight 0 the rows
        sum to the alpha of the view.
    """
    view = _project(gaussians, camera, threads)
    row_start, columns, weights = sparse_weights(view, min_weight, threads)
    if row_start[-1] < np.iinfo(np.int32).max:
        row_start = row_start.astype(np.int32)
    shape = (camera.size_hw[0] * camera.size_hw[1], len(gaussians))
    matrix = csr_matrix((weights, columns, row_start), shape=shape, copy=False)
    matrix.has_sorted_indices = True
    return matrix


def _project(gaussians: Gaussians, camera: Camera, threads: int) -> Projected:
    return project_gaussians(to_parameters(gaussians), camera, 0, threads)
