"""A rendered view as users see it (`hilsplat.render`)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from hilsplat.base.errors import SettingsError, require_kind
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.api import draw


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
