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
from hilsplat.splat.rasterise import cpu, cuda
from hilsplat.splat.rasterise.cpu import (
    Drawn,
    Parameters,
    blend_forward,
    blend_gradients,
    project_gaussians,
    sparse_weights,
)
from hilsplat.splat.rasterise.device import Device


@dataclass(frozen=True)
class Rendering:
    """What one view shows.

    Attributes:
        color: RGB over the background.
        alpha: coverage in [0, 1], the sum of the blending weights.
        features: blended features, premultiplied (divide by alpha for their average), or None.
    """

    color: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    features: Float[Tensor, "H W D"] | None = None


def to_parameters(gaussians: Gaussians) -> Parameters:
    """Gaussians as contiguous float32 arrays, which share memory with tensors that are so already."""
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
            f"spherical harmonics of degree {degree} are not available",
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
        ctx.replay = (parameters, view, channels, image, alpha, threads)
        ctx.inputs = [(tensor.device, tensor.dtype) for tensor in tensors]
        ctx.features = (features.device, features.dtype) if features is not None else None
        return torch.from_numpy(image), torch.from_numpy(alpha)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        parameters, view, channels, image, alpha, threads = ctx.replay
        grad_image, grad_alpha = (_to_array(grad) for grad in grads)
        g = blend_gradients(parameters, view, channels, image, alpha, grad_image, grad_alpha, threads)
        arrays = (g.means, g.log_scales, g.quats, g.opacity_logits, g.sh)
        out = [torch.from_numpy(a).to(*place) for a, place in zip(arrays, ctx.inputs, strict=True)]
        by_features = torch.from_numpy(g.features).to(*ctx.features) if ctx.features else None
        return *out, by_features, None, None, None


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    features: Float[Tensor, "N D"] | None = None,
    sh_degree: int | None = None,
    threads: int = 1,
    device: Device = "cpu",
) -> Rendering:
    """Render a view; differentiable in all parameters of the Gaussians and in `features`.

    The conventions are gsplat's, on both devices:

    - the centre of the top-left pixel is (0.5, 0.5);
    - a Gaussian is projected by the perspective Jacobian at its centre, with the ray clamped to 30 %
      beyond the image, and 0.3 px^2 are added to its variance (`eps2d`), whatever its size;
    - Gaussians nearer than depth 0.01 are not drawn; no Gaussian is too small (`radius_clip` 0);
    - scales are cut at exp(20) scene units, where a Gaussian covers any view evenly (CPU; gsplat
      overflows);
    - alpha below 1/255 is not drawn, alpha above 0.999 is cut there;
    - blending goes front to back by the depth of the centres and stops before the Gaussian that
      would leave less than 1e-4 of the light;
    - colour is max(0, 0.5 + spherical harmonics) in the direction from the camera to the centre;
    - features are premultiplied by alpha, and the background reaches colour alone.

    So one round Gaussian of scale s and opacity o on the optical axis at depth z has, r px from the
    principal point, under a camera of focal length f px,

        alpha = o exp(-r^2 / (2 ((f s / z)^2 + 0.3))), if that is at least 1/255.

    Gaussians behind the camera get zero gradient; without any Gaussian the background shows.
    Gradients are first-order only and do not reach the camera.

    Args:
        features: further channels to blend in the same pass; any number.
        sh_degree: degree of the spherical harmonics to use; all of them by default.
        threads: CPU threads; the result has the same bytes for any number.
        device: backend; see `device.choose_device`.

    Returns:
        images on the device of `gaussians`.

    Raises:
        HilsplatError: parameters are not finite, quaternions are zero, or features have another number
            of rows.
    """
    degree = _checked_degree(gaussians, sh_degree)
    g = gaussians
    if features is not None and len(features) != len(g):
        raise HilsplatError(
            "features do not fit the Gaussians",
            expected=f"{len(g)} rows",
            found=f"{len(features)} rows",
        )
    if device == "cuda":
        image, alpha = cuda.render_channels(g, camera, degree, features)
    else:
        image, alpha = _Render.apply(
            g.means, g.log_scales, g.quats, g.opacity_logits, g.sh, features, camera, degree, threads
        )
    behind = torch.tensor(background, dtype=image.dtype, device=image.device)
    color = image[..., :3] + (1.0 - alpha)[..., None] * behind
    return Rendering(color, alpha, image[..., 3:] if features is not None else None)


def draw(parameters: Parameters, camera: Camera, degree: int, *, threads: int, device: Device) -> Drawn:
    """One view of a fit, on plain arrays: image, alpha, and the gradients on demand.

    Raises:
        HilsplatError: parameters are not finite, or quaternions have length zero.
    """
    if device == "cuda":
        return cuda.draw(parameters, camera, degree)
    return cpu.draw(parameters, camera, degree, threads)


def pixel_weights(
    gaussians: Gaussians, camera: Camera, *, min_weight: float, threads: int = 1, device: Device = "cpu"
) -> csr_matrix:
    """Blending weight alpha_i T_i of each Gaussian at each pixel, as a sparse matrix.

    Args:
        min_weight: weights below are dropped; 0 keeps all that are drawn.

    Returns:
        float32 matrix (H W, N), rows row-major pixels, columns sorted. With min_weight 0 the rows
        sum to the alpha of the view.
    """
    if device == "cuda":
        return cuda.pixel_weights(gaussians, camera, min_weight)
    view = project_gaussians(to_parameters(gaussians), camera, 0, threads)
    row_start, columns, weights = sparse_weights(view, min_weight, threads)
    if row_start[-1] < np.iinfo(np.int32).max:
        row_start = row_start.astype(np.int32)
    shape = (camera.size_hw[0] * camera.size_hw[1], len(gaussians))
    matrix = csr_matrix((weights, columns, row_start), shape=shape, copy=False)
    matrix.has_sorted_indices = True
    return matrix
