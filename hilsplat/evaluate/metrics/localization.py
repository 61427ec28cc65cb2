"""Localization: whether the most relevant point is on the queried object."""

import numpy as np
from jaxtyping import Bool, Float, Int

from hilsplat.base.levels import LEVELS, Level


def peak_points(
    filtered: Float[np.ndarray, "3 H W"], level: Level | None
) -> tuple[Int[np.ndarray, "P 2"], Level]:
    """Return all pixels (x, y) with the maximum of a filtered map, and the level of the map.

    Without a level, the one with the largest maximum is used; the finest wins ties, as in LangSplat.
    """
    if level is None:
        level = max(LEVELS, key=lambda each: (filtered[each.index].max(), each.index))
    chosen = filtered[level.index]
    pixels = np.flatnonzero(chosen == chosen.max())  # np.nonzero in two dimensions is six times slower
    return np.stack([pixels % chosen.shape[1], pixels // chosen.shape[1]], axis=1), level


def hits_a_box(points_xy: Int[np.ndarray, "P 2"], boxes_xyxy: Int[np.ndarray, "B 4"]) -> bool:
    """Return whether any point is in any box, borders included (x1 <= x <= x2), as in LERF."""
    x, y = points_xy[:, None, 0], points_xy[:, None, 1]
    x1, y1, x2, y2 = (boxes_xyxy[None, :, side] for side in range(4))
    return bool(((x1 <= x) & (x <= x2) & (y1 <= y) & (y <= y2)).any())


def hits_the_mask(points_xy: Int[np.ndarray, "P 2"], truth: Bool[np.ndarray, "H W"]) -> bool:
    """Return whether any point is in the true region, which is stricter than the box."""
    return bool(truth[points_xy[:, 1], points_xy[:, 0]].any())


def box_of(mask: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, " 4"]:
    """Return the box of a region with its borders included: first and last column and row.

    Boxes elsewhere in this package are end-exclusive; LERF's test includes borders.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return np.array([columns[0], rows[0], columns[-1], rows[-1]])
