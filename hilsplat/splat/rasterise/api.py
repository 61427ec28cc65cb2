"""Render Gaussians in a view: images with gradients, feature maps, sparse weights."""

import numpy as np
from jaxtyping import Float32
from scipy.sparse import csr_matrix

from hilsplat.base.errors import HilsplatError
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.cpu import (
    Drawn,
    Gradients,
    blend_forward,
    blend_gradients,
    project_gaussians,
    sparse_weights,
)
from hilsplat.splat.rasterise.device import Device


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    threads: int = 1,
) -> Float32[np.ndarray, "H W 3"]:
    """Render a view on the CPU as RGB over a background; arguments and errors are those of `draw`."""
    seen = draw(gaussians, camera, gaussians.sh_degree, threads=threads)
    return seen.image + (1 - seen.alpha)[..., None] * np.array(background, np.float32)


def draw(
    gaussians: Gaussians,
    camera: Camera,
    degree: int,
    *,
    features: Float32[np.ndarray, "N D"] | None = None,
    threads: int = 1,
    device: Device = "cpu",
) -> Drawn:
    """Draw the image and alpha of a view without background, and compute gradients on demand.

    The conventions are those of gsplat (docs/rasteriser.md). Gaussians behind the camera get zero gradients.
    Gradients are first-order and are not computed for the camera.

    Args:
        features: any number of additional channels to blend in the same pass.
        threads: CPU threads; the result is byte-identical for any number.
        device: backend; see `device.choose_device`.

    Raises:
        HilsplatError: if parameters are not finite, quaternions are zero, or the degree is above 3.
    """
    if degree > 3:
        raise HilsplatError(f"spherical harmonics of degree {degree} cannot be drawn", expected="at most 3")
    if device == "cuda" and len(gaussians):  # gsplat needs at least one Gaussian
        from hilsplat.splat.rasterise import cuda

        return cuda.draw(gaussians, camera, degree, features)
    view = project_gaussians(gaussians, camera, degree, threads)
    channels = view.colours
    if features is not None:
        channels = np.concatenate([channels, features], axis=1)
    image, alpha = blend_forward(view, channels, threads)

    def gradients(grad_image: np.ndarray, grad_alpha: np.ndarray) -> Gradients:
        return blend_gradients(gaussians, view, channels, image, alpha, grad_image, grad_alpha, threads)

    return Drawn(image, alpha, view.box[:, 1] >= view.box[:, 0], gradients)


def pixel_weights(
    gaussians: Gaussians, camera: Camera, *, min_weight: float, threads: int = 1, device: Device = "cpu"
) -> csr_matrix:
    """Return the blending weight alpha_i T_i of each Gaussian at each pixel: a float32 matrix (H W, N).

    Rows are row-major pixels; columns are sorted. Weights below `min_weight` are omitted; if that is 0,
    rows sum to the view's alpha.
    """
    if device == "cuda" and len(gaussians):
        from hilsplat.splat.rasterise import cuda

        return cuda.pixel_weights(gaussians, camera, min_weight)
    view = project_gaussians(gaussians, camera, 0, threads)
    return sparse_weights(view, min_weight, threads)
