"""Regions as polygons, rasterised as in the published evaluations, and traced back from pixels."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

Polygon = Float[np.ndarray, "_ 2"] | Int[np.ndarray, "_ 2"] | Sequence[tuple[int, int]]


def fill_polygons(polygons: Sequence[Polygon], size_hw: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Return the union of polygons (vertices x, y): truncated to integers, even-odd fill, border included.

    This is OpenCV's `fillPoly` on int32 vertices, used by LangSplat's evaluation. Pixel (x, y) is the vertex
    (x, y) itself: the triangle (0, 0), (2, 0), (0, 2) has 6 pixels. Anything outside the image is clipped.
    """
    import cv2

    canvas = np.zeros(size_hw, dtype=np.uint8)
    for polygon in polygons:  # a single call would omit pixels that two polygons share
        cv2.fillPoly(canvas, [np.asarray(polygon).astype(np.int32)], 1)
    return canvas.astype(bool)


def trace_polygons(mask: Bool[np.ndarray, "H W"]) -> list[Int[np.ndarray, "_ 2"]]:
    """Return disjoint polygons whose union, filled by `fill_polygons`, equals the mask exactly.

    A polygon cannot have a hole, so the mask is cut vertically through the middle of each hole.
    """
    import cv2

    mode, every = cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE
    contours, ranks = cv2.findContours(mask.astype(np.uint8), mode, every)
    if not contours:
        return []
    holes = [contour for contour, rank in zip(contours, ranks[0], strict=True) if rank[3] >= 0]
    middles = {int(contour[..., 0].min() + contour[..., 0].max() + 1) // 2 for contour in holes}
    edges = [0, *sorted(middles), mask.shape[1]]
    polygons: list[np.ndarray] = []
    for left, right in pairwise(edges):
        strip = np.ascontiguousarray(mask[:, left:right], np.uint8)
        for contour in cv2.findContours(strip, mode, every)[0]:
            points = contour.reshape(-1, 2).astype(np.int64) + np.array([left, 0])
            polygons.append(np.concatenate([points, points[-1:].repeat(max(0, 3 - len(points)), axis=0)]))
    return polygons
