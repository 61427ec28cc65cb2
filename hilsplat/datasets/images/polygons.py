"""Regions as polygons, rasterised as in the published evaluations."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float


def fill_polygon(points_xy: Float[np.ndarray, "P 2"], size_hw: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Pixels of one polygon: vertices truncated to whole numbers, even-odd fill, border pixels included.

    This is OpenCV's `fillPoly` on int32 vertices, which LangSplat's evaluation uses. Pixel (x, y) is the
    vertex (x, y) itself: the triangle (0, 0), (2, 0), (0, 2) has 6 pixels. Anything outside the image is
    clipped.
    """
    import cv2

    canvas = np.zeros(size_hw, dtype=np.uint8)
    cv2.fillPoly(canvas, [np.asarray(points_xy).astype(np.int32)], 1)
    return canvas.astype(bool)


def outside_px(polygons: Sequence[Float[np.ndarray, "_ 2"]], size_hw: tuple[int, int]) -> float:
    """How far the vertices of polygons reach beyond the outermost pixels, px; 0 if none does."""
    points = np.concatenate(polygons)
    last = np.array([size_hw[1], size_hw[0]], dtype=np.float64)
    return float(max((-points).max(), (points - last).max(), 0.0))
