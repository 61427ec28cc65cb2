"""Localization: does the most relevant point lie on the queried object?"""

import numpy as np
from jaxtyping import Bool, Float, Int

from hilsplat.base.levels import LEVELS, Level


def peak_points(
    filtered: Float[np.ndarray, "3 H W"], level: Level | None
) -> tuple[Int[np.ndarray, "P 2"], Level]:
    """All pixels (x, y) that hold the maximum of a filtered map.

    Without a level, the one with the largest maximum; ties go to the finest, as in LangSplat.
    """
    if level is None:
        level = max(LEVELS, key=lambda each: (filtered[each.index].max(), each.index))
    chosen = filtered[level.index]
    pixels = np.flatnonzero(chosen == chosen.max())  # nonzero in two dimensions is six times slower
    return np.stack([pixels % chosen.shape[1], pixels // chosen.shape[1]], axis=1), level


def hits_a_box(points_xy: Int[np.ndarray, "P 2"], boxes_xyxy: Int[np.ndarray, "B 4"]) -> bool:
    """True if any point lies in any box, borders included (x1 <= x <= x2): LERF's test."""
    x, y = points_xy[:, None, 0], points_xy[:, None, 1]
    x1, y1, x2, y2 = (boxes_xyxy[None, :, side] for side in range(4))
    return bool(((x1 <= x) & (x <= x2) & (y1 <= y) & (y <= y2)).any())


def hits_the_mask(points_xy: Int[np.ndarray, "P 2"], truth: Bool[np.ndarray, "H W"]) -> bool:
    """True if any point lies in the true region: stricter than the box."""
    return bool(truth[points_xy[:, 1], points_xy[:, 0]].any())


def box_of(mask: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, " 4"]:
    """Box of a region with its borders included: first and last column and row.

    Unlike boxes elsewhere in this package, whose ends are exclusive: LERF's test includes borders.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return np.array([columns[0], rows[0], columns[-1], rows[-1]])
