"""Pictures and picked pixels, computed by the pipeline's own rasteriser."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, Num, UInt8
from scipy.special import logit

from cpusplat.blend import MAX_ALPHA, MIN_TRANSMITTANCE
from cpusplat.project import MIN_ALPHA
from cpusplat.views import blend_forward
from hilsplat.base.images import to_uint8
from hilsplat.base.levels import LEVELS, NONE
from hilsplat.query.scene_views import heaviest_node
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.api import project_gaussians
from hilsplat.viewer.wire import Style, rows_of

GREY = np.array([0.299, 0.587, 0.114], np.float32)
TINT = np.float32(0.35)
"""Luminance factor of unselected Gaussians in `tint` mode. The page's shader has the same numbers."""
GHOST = np.float32(0.08)  # opacity factor of unselected Gaussians in `ghost` mode

MARKED = np.array([255, 0, 160], np.float32) / 255
MARKED_SHARE = np.float32(0.7)
"""Colour of Gaussians selected for editing, and its weight; `styles.js` has the same numbers."""

NEAR = 0.01  # minimum depth of a Gaussian that can be selected, as in the rasteriser
SEEN = 0.05  # minimum alpha of a pixel that can be picked


@dataclass(frozen=True)
class Paint:
    """A style, resolved for each Gaussian: `share` is the weight of `rgb` in its colour; 0 if unselected."""

    rgb: Float32[np.ndarray, "N 3"]
    share: Float32[np.ndarray, " N"]
    mode: str

    @property
    def hidden(self) -> Bool[np.ndarray, " N"]:
        """Whether each Gaussian is invisible."""
        return (self.share == 0) & (self.mode == "isolate")

    @staticmethod
    def plain(count: int) -> "Paint":
        """Return the scene's own colours."""
        return Paint(np.zeros((count, 3), np.float32), np.zeros(count, np.float32), "plain")

    def marking(self, marked: Bool[np.ndarray, " N"]) -> "Paint":
        """Return the paint with Gaussians that are selected for editing in their colour."""
        rgb = np.where(marked[:, None], MARKED, self.rgb)
        return replace(self, rgb=rgb, share=np.where(marked, MARKED_SHARE, self.share))

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
            SettingsError: the table has the wrong number of rows, or isn't base64.
        """
        if style.ramp:
            assert relevancy is not None
            share = np.full(len(relevancy), 0.8, np.float32)
            return Paint(rows_of(style.ramp, 3, 256)[relevancy].astype(np.float32) / 255, share, "plain")
        table = rows_of(style.table, 4, num_nodes + 1).astype(np.float32) / 255
        colours = np.zeros((len(node_of_gaussian), 4), np.float32)
        for level in range(3):  # coarse to fine, so that finer levels override coarser ones
            if style.use[level]:
                of_level = table[node_of_gaussian[:, level] + 1]
                colours = np.where(of_level[:, 3:] > 0, of_level, colours)
        return Paint(colours[:, :3], np.ascontiguousarray(colours[:, 3]), style.mode)


def faded(gaussians: Gaussians, factor: Num[np.ndarray, " N"] | Bool[np.ndarray, " N"]) -> Gaussians:
    """Multiply each opacity by a factor; a Gaussian with factor 0 is invisible."""
    logits = logit(np.clip(gaussians.opacities * factor, 1e-13, 1 - 1e-6)).astype(np.float32)
    return replace(gaussians, opacity_logits=logits)


def painted(
    gaussians: Gaussians, camera: Camera, paint: Paint | None = None, threads: int = 1
) -> UInt8[np.ndarray, "H W 3"]:
    """Render a view over black, like `render`, in the colours of a style.

    A selected Gaussian's colour c becomes c (1 - share) + rgb share. Unselected Gaussians are unchanged in
    mode `plain`, dark grey in `tint`, nearly transparent in `ghost`, and invisible in `isolate`.
    """
    degree = min(gaussians.sh_degree, 3)
    if paint is None:
        view = project_gaussians(gaussians, camera, degree, threads)
        return to_uint8(blend_forward(view, view.colours, threads)[0])
    others = paint.share == 0
    if paint.mode in ("ghost", "isolate"):
        gaussians = faded(gaussians, np.where(others, GHOST if paint.mode == "ghost" else 0, 1))
    view = project_gaussians(gaussians, camera, degree, threads)
    colours = view.colours
    if paint.mode == "tint":
        colours = np.where(others[:, None], (TINT * (colours @ GREY))[:, None], colours)
    share = paint.share[:, None]
    colours = np.ascontiguousarray(colours * (1 - share) + paint.rgb * share, np.float32)
    return to_uint8(blend_forward(view, colours, threads)[0])


def within(
    means: Float32[np.ndarray, "N 3"], camera: Camera, points: Sequence[tuple[float, float]], radius: float
) -> Bool[np.ndarray, " N"]:
    """Return which points of the scene are projected into a region of a view, up to its pixels.

    The region is a rectangle with two opposite corners (radius 0, first and last point), or all pixels within
    `radius` of a line through `points`; all in px.
    """
    height, width = camera.size_hw
    region = np.zeros((height, width), np.uint8)
    corners = np.rint(16 * (np.array(points) - 0.5)).astype(np.int32)  # OpenCV: pixel centres are integers
    if radius:
        line = np.concatenate([corners[:1], corners])  # a single point is not a line
        cv2.polylines(region, [line], False, 1, max(1, round(2 * radius)), cv2.LINE_8, shift=4)
    else:
        cv2.rectangle(region, corners[0], corners[-1], 1, cv2.FILLED, cv2.LINE_8, shift=4)
    pose = camera.cam_from_world
    in_camera = means.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    ahead = np.flatnonzero(in_camera[:, 2] > NEAR)
    x, y, z = (in_camera[ahead] @ camera.K.T).T
    column, row = np.floor(x / z), np.floor(y / z)
    in_picture = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside = np.zeros(len(means), np.bool_)
    inside[ahead[in_picture]] = region[row[in_picture].astype(int), column[in_picture].astype(int)] > 0
    return inside


def weights_at(
    gaussians: Gaussians, camera: Camera, x: int, y: int, threads: int = 1
) -> tuple[Int64[np.ndarray, " g"], Float64[np.ndarray, " g"]]:
    """Return one pixel's Gaussians, nearest first, and their blending weights, like a row of `pixel_weights`.

    The whole view is projected, because the Jacobian depends on its borders; only this pixel is blended.
    """
    view = project_gaussians(gaussians, camera, 0, threads)
    first_x, last_x, first_y, last_y = view.box.T
    rows = np.flatnonzero((first_x <= x) & (x <= last_x) & (first_y <= y) & (y <= last_y))
    mean_x, mean_y, a, b, c, peak, depth, _ = view.geometry[rows, :8].astype(np.float64).T
    dx, dy = mean_x - (x + 0.5), mean_y - (y + 0.5)
    alpha = np.exp2(peak - (a * dx * dx + b * dx * dy + c * dy * dy))
    blended = np.flatnonzero(alpha >= MIN_ALPHA)
    blended = blended[np.lexsort((rows[blended], depth[blended]))]
    alpha = np.minimum(alpha[blended], MAX_ALPHA)
    after = np.cumprod(1 - alpha)
    is_seen = after >= MIN_TRANSMITTANCE
    before = np.append(1.0, after)[:-1]
    return rows[blended[is_seen]], (alpha * before)[is_seen]


def pick(
    gaussians: Gaussians,
    node_of_gaussian: Int32[np.ndarray, "N 3"] | None,
    camera: Camera,
    x: float,
    y: float,
    threads: int = 1,
) -> dict[str, Any] | None:
    """Return the content of the pixel at (x, y); None outside the picture or if alpha is below `SEEN`.

    `nodes` has, per level, the node with the largest weight in the pixel (-1 for none) and its share of the
    alpha; `point` is the Gaussians' mean position, weighted by their blending weights, in scene units.
    """
    height, width = camera.size_hw
    if not (0 <= x < width and 0 <= y < height):
        return None
    rows, weights = weights_at(gaussians, camera, int(x), int(y), threads)
    alpha = float(weights.sum())
    if alpha < SEEN:
        return None
    nodes = []
    for level in LEVELS:
        node, weight = NONE, 0.0
        if node_of_gaussian is not None:
            node, weight = heaviest_node(node_of_gaussian[rows, level.index], weights)
        nodes.append((node, weight / alpha))
    return {"nodes": nodes, "alpha": alpha, "point": (weights @ gaussians.means[rows] / alpha).tolist()}
