"""Render Gaussians in a view on the CPU: images with gradients, feature maps, sparse weights."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy.sparse import csr_matrix

from cpusplat import views
from cpusplat.project import pack_camera
from hilsplat.base.errors import HilsplatError, SettingsError, require_kind
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians


@dataclass(frozen=True)
class Drawn:
    image: Float32[np.ndarray, "H W C"]  # premultiplied RGB, then features, without background
    alpha: Float32[np.ndarray, "H W"]  # coverage in [0, 1], the sum of the blending weights
    drawn: Bool[np.ndarray, " N"]  # whether each Gaussian reaches a pixel of the view
    # maps gradients of image and alpha to those of the parameters, and of the projected means [N 2] in px
    gradients: Callable[[np.ndarray, np.ndarray], tuple[views.Parameters, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Rendering:
    """A rendered view, as arrays of height H and width W.

    Attributes:
        colours: RGB over the background, mostly in [0, 1].
        depth: mean z of the Gaussians in camera coordinates (not along the ray), weighted as they are
            blended; scene units, NaN in pixels without Gaussians.
        features: sums of the Gaussians' features, weighted as they are blended; D is 0 if none were given.
        alpha: sum of the weights, in [0, 1].
    """

    colours: Float32[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]
    features: Float32[np.ndarray, "H W D"]
    alpha: Float32[np.ndarray, "H W"]

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"Rendering({width} x {height} px, {self.features.shape[2]} features)"


def render(
    gaussians: Gaussians,
    camera: Camera,
    features: Float32[np.ndarray, "N D"] | None = None,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    threads: int = 1,
) -> Rendering:
    """Render colours, depth, features and alpha of a view on the CPU, in one pass.

    Args:
        camera: such as `scene.cameras[0]`, `scene.cameras["000.png"]`, or one of these `.scaled((H, W))`.
        features: D values per Gaussian, blended like its colours.
        threads: does not affect the result.

    Raises:
        SettingsError: an argument has the wrong type, the background is not a colour, or there are not as
            many features as Gaussians.
        HilsplatError: Gaussians have non-finite parameters.
    """
    require_kind(gaussians, Gaussians, "read them: hilsplat.load_gaussians(...)")
    require_kind(camera, Camera, "pass scene.cameras[...], or use scene.render(view)")
    if np.shape(background) != (3,):
        raise SettingsError("the background is not a colour", expected="3 numbers", found=repr(background))
    if features is not None and len(features) != len(gaussians):
        raise SettingsError(
            "features do not match the Gaussians", expected=f"({len(gaussians)}, D)", found=np.shape(features)
        )
    z = gaussians.means @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
    channels = z[:, None] if features is None else np.column_stack([z, features])
    channels = channels.astype(np.float32)
    seen = draw(gaussians, camera, gaussians.sh_degree, features=channels, threads=threads)
    colours, depth, blended = np.split(seen.image, (3, 4), axis=2)
    colours = colours + (1 - seen.alpha)[..., None] * np.array(background, np.float32)
    with np.errstate(invalid="ignore"):
        return Rendering(colours, depth[..., 0] / seen.alpha, blended, seen.alpha)


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
