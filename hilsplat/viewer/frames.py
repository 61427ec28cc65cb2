"""Pictures rendered by the pipeline's own rasteriser, for browsers without usable WebGL.

Films and stills use it too, and a test compares the page's WebGL with it.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from hilsplat.base.images import to_uint8
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.cpu import blend_forward, project_gaussians
from hilsplat.viewer.wire import Style

GREY = np.array([0.299, 0.587, 0.114], np.float32)
TINT = np.float32(0.35)
"""Brightness of the grey of unselected Gaussians in `tint`. The page's shader has the same numbers."""
GHOST = np.float32(0.08)
"""Share of their opacity that `ghost` leaves to unselected Gaussians."""


@dataclass(frozen=True)
class Paint:
    """A style, resolved for each Gaussian.

    Attributes:
        rgb: colour that is mixed in.
        share: share of that colour, in [0, 1]; 0 means unselected.
        mode: how unselected Gaussians are painted.
    """

    rgb: Float32[np.ndarray, "N 3"]
    share: Float32[np.ndarray, " N"]
    mode: str

    @staticmethod
    def of(
        style: Style,
        node_of_gaussian: Int32[np.ndarray, "N 3"],
        num_nodes: int,
        relevancy: UInt8[np.ndarray, " N"] | None = None,
    ) -> "Paint":
        """Resolve a style: the finest used level whose node has an alpha above 0 sets a Gaussian's colour.

        Relevancy is in steps of 1/255, and required if the style has a ramp.

        Raises:
            ValueError: the table has another number of rows.
        """
        if style.ramp:
            assert relevancy is not None
            share = np.full(len(relevancy), 0.8, np.float32)
            return Paint(style.colours()[relevancy].astype(np.float32) / 255, share, "plain")
        table = style.rgba(num_nodes).astype(np.float32) / 255
        found = np.zeros((len(node_of_gaussian), 4), np.float32)
        for level in range(3):  # coarse to fine, so that finer levels override coarser ones
            if style.use[level]:
                own = table[node_of_gaussian[:, level] + 1]
                found = np.where(own[:, 3:] > 0, own, found)
        return Paint(found[:, :3], np.ascontiguousarray(found[:, 3]), style.mode)


def painted(
    gaussians: Gaussians, camera: Camera, paint: Paint | None = None, threads: int = 1
) -> UInt8[np.ndarray, "H W 3"]:
    """Render a view over black, as `render` does, in the colours of a style.

    A selected Gaussian's colour c becomes c (1 - share) + rgb share. Unselected ones are unchanged with
    `plain`, dark grey with `tint`, nearly transparent with `ghost`, and invisible with `isolate`.
    """
    degree = min(gaussians.sh_degree, 3)
    if paint is None:
        view = project_gaussians(gaussians, camera, degree, threads)
        return to_uint8(blend_forward(view, view.colours, threads)[0])
    others = paint.share == 0
    if paint.mode in ("ghost", "isolate"):
        opacity = gaussians.opacities.astype(np.float32)
        opacity[others] *= GHOST if paint.mode == "ghost" else np.float32(0)
        with np.errstate(divide="ignore"):
            logits = np.log(opacity) - np.log1p(-np.minimum(opacity, np.float32(1 - 1e-6)))
        gaussians = replace(gaussians, opacity_logits=np.maximum(logits, np.float32(-30)))
    view = project_gaussians(gaussians, camera, degree, threads)
    colours = view.colours
    if paint.mode == "tint":
        colours = np.where(others[:, None], (TINT * (colours @ GREY))[:, None], colours)
    share = paint.share[:, None]
    colours = np.ascontiguousarray(colours * (1 - share) + paint.rgb * share, np.float32)
    return to_uint8(blend_forward(view, colours, threads)[0])
