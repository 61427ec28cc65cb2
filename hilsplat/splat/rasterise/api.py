"""Render Gaussians in a view on the CPU: images with gradients, feature maps, sparse weights."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy.sparse import csr_matrix

from cpusplat import views
from cpusplat.project import pack_camera
from hilsplat.base.errors import HilsplatError
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians


@dataclass(frozen=True)
class Drawn:
    image: Float32[np.ndarray, "H W C"]  # premultiplied RGB, then features, without background
    alpha: Float32[np.ndarray, "H W"]  # coverage in [0, 1], the sum of the blending weights
    drawn: Bool[np.ndarray, " N"]  # whether each Gaussian reaches a pixel of the view
    # maps gradients of image and alpha to those of the parameters, and of the projected means [N 2] in px
    gradients: Callable[[np.ndarray, np.ndarray], tuple[views.Parameters, np.ndarray]]


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    threads: int = 1,
) -> Float32[np.ndarray, "H W 3"]:
    """Render a view as RGB over a background; arguments and errors are those of `draw`."""
    seen = draw(gaussians, camera, gaussians.sh_degree, threads=threads)
    return seen.image + (1 - seen.alpha)[..., None] * np.array(background, np.float32)


def draw(
    gaussians: Gaussians,
    camera: Camera,
    degree: int,
    *,
    features: Float32[np.ndarray, "N D"] | None = None,
    threads: int = 1,
) -> Drawn:
    """Draw the image and alpha of a view without background, and compute gradients on demand.

    The conventions are those of gsplat (docs/rasteriser.md). Gaussians behind the camera get zero gradients.
    Gradients are first-order and are not computed for the camera.

    Args:
        features: any number of additional channels to blend in the same pass.
        threads: CPU threads; the result is byte-identical for any number.

    Raises:
        HilsplatError: if parameters are not finite, or quaternions are zero.
    """
    view = project_gaussians(gaussians, camera, degree, threads)
    channels = view.colours
    if features is not None:
        channels = np.concatenate([channels, features], axis=1)
    image, alpha = views.blend_forward(view, channels, threads)

    def gradients(grad_image: np.ndarray, grad_alpha: np.ndarray) -> tuple[views.Parameters, np.ndarray]:
        sums = views.blend_gradients(view, channels, image, alpha, grad_image, grad_alpha, threads)
        return views.project_gradients(view, sums, threads)

    return Drawn(image, alpha, view.drawn, gradients)


def project_gaussians(gaussians: Gaussians, camera: Camera, degree: int, threads: int) -> views.Projected:
    """Project all Gaussians into a view on the CPU; raise the errors of `draw`."""
    parameters = views.Parameters(*(getattr(gaussians, name) for name in FIELDS))
    row = pack_camera(camera.cam_from_world, camera.K, camera.size_hw)
    view = views.project_gaussians(parameters, row, degree, threads)
    refuse_broken(view.broken, len(gaussians))
    return view


def pixel_weights(
    gaussians: Gaussians, camera: Camera, *, min_weight: float, threads: int = 1, step: int = 1
) -> csr_matrix:
    """Return the blending weight alpha_i T_i of each Gaussian at each pixel: a float32 matrix (H W, N).

    Rows are row-major pixels; columns are sorted. Weights below `min_weight` are omitted; if that is 0,
    rows sum to the view's alpha. Rows of pixels outside every `step`-th row and column are empty.
    """
    view = project_gaussians(gaussians, camera, 0, threads)
    return weight_matrix(*views.sparse_weights(view, min_weight, threads, step), len(gaussians))


def refuse_broken(broken: int, total: int) -> None:
    """Raise HilsplatError if any Gaussian cannot be drawn."""
    if broken:
        raise HilsplatError(
            f"{broken} of {total} Gaussians cannot be drawn: non-finite parameters or a zero quaternion",
            expected="finite means, log_scales, quats, opacity_logits and sh",
            fix="drop these Gaussians, or rerun the gaussians stage",
        )


def weight_matrix(
    weights: np.ndarray, columns: np.ndarray, row_start: np.ndarray, num_gaussians: int
) -> csr_matrix:
    """Build a matrix from CSR arrays with sorted columns; scipy converts row starts to int32 if they fit."""
    shape = (len(row_start) - 1, num_gaussians)
    matrix = csr_matrix((weights, columns, row_start), shape=shape, copy=False)
    matrix.has_sorted_indices = True
    return matrix
