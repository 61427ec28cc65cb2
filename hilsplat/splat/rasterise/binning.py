"""Depth order and tile lists of a view: which Gaussians each 16x16 tile blends, front to back."""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Int32, Int64
from numba import njit

TILE = 16
"""Side of a tile, px."""


@dataclass(frozen=True)
class TileLists:
    """Pairs of (tile, Gaussian), in two orders.

    Attributes:
        tile_start: entries of tile t are tile_start[t] .. tile_start[t + 1], front to back.
        gaussian: the Gaussian of an entry.
        pair: the gradient slot of an entry; slots are grouped by Gaussian.
        pair_start: slots of Gaussian i are pair_start[i] .. pair_start[i + 1].
    """

    tile_start: Int64[np.ndarray, " num_tiles_plus_1"]
    gaussian: Int32[np.ndarray, " P"]
    pair: Int64[np.ndarray, " P"]
    pair_start: Int64[np.ndarray, " N_plus_1"]


@njit(nogil=True, cache=True)
@no_type_check
def _depth_order(keys):
    """Rows in order of ascending uint32 keys: least-significant-digit radix sort, 3 x 11 bits, stable."""
    n = len(keys)
    order, other = np.empty(n, np.int32), np.empty(n, np.int32)
    for i in range(n):
        order[i] = i
    count = np.empty(2048, np.int64)
    for shift in range(0, 33, 11):
        count[:] = 0
        for i in range(n):
            count[(keys[i] >> shift) & 2047] += 1
        total = 0
        for digit in range(2048):
            here = count[digit]
            count[digit] = total
            total += here
        for i in range(n):
            row = order[i]
            digit = (keys[row] >> shift) & 2047
            other[count[digit]] = row
            count[digit] += 1
        order, other = other, order
    return order


@njit(nogil=True, cache=True)
@no_type_check
def _bin(box, keys, tiles_x, tiles_y):
    n = len(box)
    pair_start = np.zeros(n + 1, np.int64)
    tile_start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    visible = 0
    for i in range(n):
        if box[i, 1] >= box[i, 0]:
            x0, x1 = box[i, 0] // TILE, box[i, 1] // TILE
            y0, y1 = box[i, 2] // TILE, box[i, 3] // TILE
            pair_start[i + 1] = (x1 - x0 + 1) * (y1 - y0 + 1)
            visible += 1
            for y in range(y0, y1 + 1):
                for x in range(x0, x1 + 1):
                    tile_start[y * tiles_x + x + 1] += 1
    for i in range(n):
        pair_start[i + 1] += pair_start[i]
    for tile in range(tiles_x * tiles_y):
        tile_start[tile + 1] += tile_start[tile]
    rows, visible_keys = np.empty(visible, np.int32), np.empty(visible, np.uint32)
    at = 0
    for i in range(n):
        if box[i, 1] >= box[i, 0]:
            rows[at] = i
            visible_keys[at] = keys[i]
            at += 1
    order = _depth_order(visible_keys)
    gaussian = np.empty(pair_start[n], np.int32)
    pair = np.empty(pair_start[n], np.int64)
    cursor = tile_start[:-1].copy()
    for k in range(visible):
        i = rows[order[k]]
        slot = pair_start[i]
        for y in range(box[i, 2] // TILE, box[i, 3] // TILE + 1):
            for x in range(box[i, 0] // TILE, box[i, 1] // TILE + 1):
                tile = y * tiles_x + x
                gaussian[cursor[tile]] = i
                pair[cursor[tile]] = slot
                cursor[tile] += 1
                slot += 1
    return tile_start, gaussian, pair, pair_start


def bin_gaussians(box: Int32[np.ndarray, "N 4"], depths: np.ndarray, size_hw: tuple[int, int]) -> TileLists:
    """Sort the visible Gaussians by depth and list them per tile (row-major tiles).

    Args:
        box: first and last pixel column, first and last pixel row; last < first is not drawn.
        depths: positive float32 depths; Gaussians of equal depth stay in row order.
        size_hw: image size, px.
    """
    tiles_y, tiles_x = ((side + TILE - 1) // TILE for side in size_hw)
    # The bits of positive floats order as the floats do.
    keys = np.ascontiguousarray(depths, dtype=np.float32).view(np.uint32)
    return TileLists(*_bin(box, keys, tiles_x, tiles_y))
