"""Regions as polygons, rasterised as the published evaluations do it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int32


def fill_polygon(points_xy: Float[np.ndarray, "P 2"], size_hw: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Pixels of one polygon: vertices cut to whole numbers, even-odd fill, border pixels included.

    This is OpenCV's `fillPoly` on int32 vertices, which LangSplat's evaluation uses. Pixel (x, y) is the
    vertex (x, y) itself: the triangle (0, 0), (2, 0), (0, 2) has 6 pixels. What lies outside is clipped.
    """
    import cv2

    canvas = np.zeros(size_hw, dtype=np.uint8)
    cv2.fillPoly(canvas, [np.asarray(points_xy).astype(np.int32)], 1)
    return canvas.astype(bool)


def polygons_of(mask: Bool[np.ndarray, "H W"]) -> list[Int32[np.ndarray, "_ 2"]]:
    """Polygons whose filled union is exactly a region.

    One per connected piece, along its border pixels. A piece that one polygon cannot give, such as a
    ring, is cut in halves until it can.
    """
    import cv2

    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    polygons: list[np.ndarray] = []
    for number in range(1, count):
        polygons.extend(_polygons_of_piece(labels == number))
    return polygons


def _polygons_of_piece(piece: Bool[np.ndarray, "H W"]) -> list[Int32[np.ndarray, "_ 2"]]:
    import cv2

    contours, _ = cv2.findContours(piece.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if len(contours) == 1:
        points = contours[0][:, 0].astype(np.int32)
        if np.array_equal(fill_polygon(points.astype(np.float64), piece.shape), piece):
            return [points]
    rows, columns = np.flatnonzero(piece.any(axis=1)), np.flatnonzero(piece.any(axis=0))
    halves = [piece.copy(), piece.copy()]
    if rows[-1] - rows[0] >= columns[-1] - columns[0]:
        middle = (rows[0] + rows[-1] + 1) // 2
        halves[0][middle:], halves[1][:middle] = False, False
    else:
        middle = (columns[0] + columns[-1] + 1) // 2
        halves[0][:, middle:], halves[1][:, :middle] = False, False
    return [polygon for half in halves for polygon in polygons_of(half)]


def outside_px(polygons: Sequence[Float[np.ndarray, "_ 2"]], size_hw: tuple[int, int]) -> float:
    """How far the vertices of polygons reach beyond the outermost pixels, px; 0 where none does."""
    points = np.concatenate(polygons)
    last = np.array([size_hw[1], size_hw[0]], dtype=np.float64)
    return float(max((-points).max(), (points - last).max(), 0.0))
