"""Regions as polygons, which the readers fill again."""

import cv2
import numpy as np
from jaxtyping import Bool, Int32

from hilsplat.datasets.images.polygons import fill_polygon


def polygons_of(mask: Bool[np.ndarray, "H W"]) -> list[Int32[np.ndarray, "_ 2"]]:
    """Polygons whose filled union is exactly a region.

    One per connected piece, along its border pixels. A piece that one polygon cannot give, such as a
    ring, is cut in halves until it can.
    """
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    polygons: list[np.ndarray] = []
    for number in range(1, count):
        polygons.extend(_polygons_of_piece(labels == number))
    return polygons


def _polygons_of_piece(piece: Bool[np.ndarray, "H W"]) -> list[Int32[np.ndarray, "_ 2"]]:
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
