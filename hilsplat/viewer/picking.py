"""Picking: the Gaussians, nodes and 3D point that a pixel of the page's picture shows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Int64

from hilsplat.base.levels import LEVELS, NONE
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.cpu import project_gaussians
from hilsplat.splat.rasterise.project import MIN_ALPHA

MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4
SEEN = 0.05
"""Minimum alpha of a pixel that shows something."""


@dataclass(frozen=True)
class Picked:
    """Content of a pixel.

    Attributes:
        alpha: accumulated alpha of the Gaussians.
        point: mean position of the Gaussians, weighted by their blending weights; scene units.
        nodes: per level, the node with the largest share of the pixel (-1 for none) and its share of alpha.
    """

    alpha: float
    point: tuple[float, float, float]
    nodes: tuple[tuple[int, float], ...]


def weights_at(
    gaussians: Gaussians, camera: Camera, x: int, y: int, threads: int = 1
) -> tuple[Int64[np.ndarray, " g"], Float64[np.ndarray, " g"]]:
    """Return the Gaussians of one pixel, nearest first, and their blending weights: a row of `pixel_weights`.

    The whole view is projected, because the Jacobian depends on the picture's borders; only this pixel is
    blended.
    """
    view = project_gaussians(gaussians, camera, 0, threads)
    first_x, last_x, first_y, last_y = view.box.T
    rows = np.flatnonzero((first_x <= x) & (x <= last_x) & (first_y <= y) & (y <= last_y))
    mean_x, mean_y, a, b, c, peak, depth, _ = view.geometry[rows, :8].astype(np.float64).T
    dx, dy = mean_x - (x + 0.5), mean_y - (y + 0.5)
    alpha = np.exp2(peak - (a * dx * dx + b * dx * dy + c * dy * dy))
    kept = np.flatnonzero(alpha >= MIN_ALPHA)
    kept = kept[np.lexsort((rows[kept], depth[kept]))]
    alpha = np.minimum(alpha[kept], MAX_ALPHA)
    left = np.cumprod(1 - alpha)
    seen = left >= MIN_TRANSMITTANCE
    before = np.concatenate([[1.0], left[:-1]]) if len(left) else left
    return rows[kept[seen]], (alpha * before)[seen]


def pick(
    gaussians: Gaussians,
    node_of_gaussian: Int32[np.ndarray, "N 3"] | None,
    camera: Camera,
    x: float,
    y: float,
    threads: int = 1,
) -> Picked | None:
    """Return what the pixel at (x, y) shows; None outside the picture or if alpha is below `SEEN`."""
    height, width = camera.size_hw
    if not (0 <= x < width and 0 <= y < height):
        return None
    rows, weights = weights_at(gaussians, camera, int(x), int(y), threads)
    alpha = float(weights.sum())
    if alpha < SEEN:
        return None
    px, py, pz = (weights @ gaussians.means[rows] / alpha).tolist()
    nodes = []
    for level in LEVELS:
        if node_of_gaussian is None:
            nodes.append((NONE, 0.0))
            continue
        own = node_of_gaussian[rows, level.index]
        share = np.bincount(own + 1, weights)  # entry 0: without a node
        share[0] = 0
        best = int(share.argmax())
        nodes.append((best - 1 if share[best] > 0 else NONE, float(share[best]) / alpha))
    return Picked(alpha, (px, py, pz), tuple(nodes))
