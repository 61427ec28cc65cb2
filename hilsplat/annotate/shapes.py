"""Regions drawn by hand: polygons and brush strokes."""

import cv2
import numpy as np
from jaxtyping import Bool

from hilsplat.annotate.labels import fill_rings, traced
from hilsplat.annotate.wire import Shape


def shaped(asked: Shape, size_hw: tuple[int, int]) -> tuple[list[list[tuple[int, int]]], int]:
    """Return polygons and area (px) of a region: polygons, plus or minus a stroke, inside another region.

    A single polygon that equals the region is returned unchanged, because few corners are easier to edit.
    """
    drawn = fill_rings(asked.add, size_hw)
    mask = _mask(asked, drawn)
    same = len(asked.add) == 1 and np.array_equal(mask, drawn)
    return (list(asked.add) if same else traced(mask)), int(np.count_nonzero(mask))


def _mask(asked: Shape, mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    size_hw = mask.shape
    if asked.stroke is not None:
        painted = np.zeros(size_hw, np.uint8)
        points = np.array(asked.stroke.points, np.int32)
        radius = asked.stroke.radius
        cv2.polylines(painted, [points], False, 1, max(1, round(2 * radius)))
        for x, y in points:  # round ends, and dots
            cv2.circle(painted, (int(x), int(y)), round(radius), 1, cv2.FILLED)
        mask = mask & (painted == 0) if asked.stroke.erase else mask | (painted > 0)
    if asked.inside is not None:
        mask &= fill_rings(asked.inside, size_hw)
    return mask
