"""Render Gaussians in a view: images with gradients, feature maps, sparse weights."""

from dataclasses import dataclass

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
    weight_matrix,
)
from hilsplat.splat.rasterise.device import Device


@dataclass(frozen=True)
class Rendering:
    """One rendered view.

    Attributes:
        color: RGB over the background.
        alpha: coverage in [0, 1], the sum of the blending weights.
        features: blended features, premultiplied (divide by alpha for their average), or None.
    """

    color: Float32[np.ndarray, "H W 3"]
    alpha: Float32[np.ndarray, "H W"]
    features: Float32[np.ndarray, "H W D"] | None = None


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    features: Float32[np.ndarray, "N D"] | None = None,
    threads: int = 1,
    device: Device = "cpu",
) -> Rendering:
    """Render a view with the conventions of gsplat (docs/rasteriser.md); `draw` also computes gradients.

    Args:
        features: any number of additional channels to blend in the same pass.
        threads: CPU threads; the result is byte-identical for any number.
        device: backend; see `device.choose_device`.

    Raises:
        HilsplatError: if parameters are not finite, quaternions are zero, spherical harmonics have a degree
            above 3, or the number of feature rows differs from the number of Gaussians.
    """
    degree = gaussians.sh_degree
    if degree > 3:
        raise HilsplatError(f"spherical harmonics of degree {degree} cannot be drawn", expected="at most 3")
    seen = draw(gaussians, camera, degree, features=features, threads=threads, device=device)
    color = seen.image[..., :3] + (1 - seen.alpha)[..., None] * np.array(background, np.float32)
    return Rendering(color, seen.alpha, seen.image[..., 3:] if features is not None else None)


def draw(
    gaussians: Gaussians,
    camera: Camera,
    degree: int,
    *,
    features: Float32[np.ndarray, "N D"] | None = None,
    threads: int,
    device: Device,
) -> Drawn:
    """Draw the image and alpha of a view without background, and compute gradients on demand.

    Gaussians behind the camera get zero gradients. Gradients are first-order and are not computed for the
    camera. Arguments and errors are those of `render`.
    """
    if features is not None and len(features) != len(gaussians):
        raise HilsplatError(
            "the features do not match the Gaussians",
            expected=f"{len(gaussians)} rows",
            found=f"{len(features)} rows",
        )
    if device == "cuda":
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
    if device == "cuda":
        from hilsplat.splat.rasterise import cuda

        return cuda.pixel_weights(gaussians, camera, min_weight)
    view = project_gaussians(gaussians, camera, 0, threads)
    return weight_matrix(*sparse_weights(view, min_weight, threads), len(gaussians))
