"""Depth order and tile lists of a view: which Gaussians each 16x16 tile blends, front to back."""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Int32, Int64

from hilsplat.base.compiled import compiled

TILE = 16
"""Side of a tile, px."""
MAX_ENTRIES = 2**21
"""Entries of tile lists held at a time: 8 MiB, and 72 MiB of gradients for 3 channels."""


@dataclass(frozen=True)
class Tiles:
    """What the tile lists of a view are made from.

    Tile t of row y and column x has index y * tiles_x + x. Its list holds the Gaussians whose box
    touches it, front to back; it has tile_start[t + 1] - tile_start[t] entries.

    Attributes:
        tiles_x: tiles per row.
        order: rows of the Gaussians that are drawn, front to back; equal depths in row order.
        tile_start: entries of the tiles before.
    """

    tiles_x: int
    order: Int32[np.ndarray, " M"]
    tile_start: Int64[np.ndarray, " num_tiles_plus_1"]

    def bands(self, max_entries: int = MAX_ENTRIES) -> list[tuple[int, int]]:
        """Ranges of tiles that cover all tiles, each with at most `max_entries` entries or one tile."""
        start, out, begin = self.tile_start, [], 0
        while begin < len(start) - 1:
            end = int(np.searchsorted(start, start[begin] + max_entries, side="right")) - 1
            end = min(max(end, begin + 1), len(start) - 1)
            out.append((begin, end))
            begin = end
        return out


@compiled
@no_type_check
def _depth_order(rows, keys):
    """Rows in order of ascending uint32 keys: least-significant-digit radix sort, 3 x 11 bits, stable."""
    n = len(rows)
    other_rows, other_keys = np.empty_like(rows), np.empty_like(keys)
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
            digit = (keys[i] >> shift) & 2047
            other_rows[count[digit]] = rows[i]
            other_keys[count[digit]] = keys[i]
            count[digit] += 1
        rows, other_rows = other_rows, rows
        keys, other_keys = other_keys, keys
    return rows


@compiled
@no_type_check
def _count(box, keys, tiles_x, tiles_y):
    """Depth order of what is drawn, and where each tile's list begins (summed from corners of boxes)."""
    corners = np.zeros((tiles_y + 1, tiles_x + 1), np.int64)
    rows, drawn_keys = np.empty(len(box), np.int32), np.empty(len(box), np.uint32)
    drawn = 0
    for i in range(len(box)):
        if box[i, 1] >= box[i, 0]:
            x0, x1 = box[i, 0] // TILE, box[i, 1] // TILE + 1
            y0, y1 = box[i, 2] // TILE, box[i, 3] // TILE + 1
            corners[y0, x0] += 1
            corners[y0, x1] -= 1
            corners[y1, x0] -= 1
            corners[y1, x1] += 1
            rows[drawn], drawn_keys[drawn] = i, keys[i]
            drawn += 1
    tile_start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    above = np.zeros(tiles_x, np.int64)
    for y in range(tiles_y):
        along = 0
        for x in range(tiles_x):
            along += corners[y, x]
            above[x] += along
            tile_start[y * tiles_x + x + 1] = tile_start[y * tiles_x + x] + above[x]
    return _depth_order(rows[:drawn], drawn_keys[:drawn]), tile_start


@compiled
@no_type_check
def fill_lists(begin, end, base, tiles_x, order, tile_start, box, gaussian):
    """Write the lists of tiles begin..end; entry e goes to gaussian[e - base]."""
    cursor = tile_start[begin:end] - base
    for k in range(len(order)):
        i = order[k]
        x0, x1 = box[i, 0] // TILE, box[i, 1] // TILE + 1
        y0, y1 = max(box[i, 2] // TILE, begin // tiles_x), box[i, 3] // TILE + 1
        for y in range(y0, min(y1, (end - 1) // tiles_x + 1)):
            for tile in range(max(y * tiles_x + x0, begin), min(y * tiles_x + x1, end)):
                gaussian[cursor[tile - begin]] = i
                cursor[tile - begin] += 1


def bin_gaussians(box: Int32[np.ndarray, "N 4"], depths: np.ndarray, size_hw: tuple[int, int]) -> Tiles:
    """Sort the drawn Gaussians by depth and count them per tile.

    Args:
        box: first and last pixel column, first and last pixel row; last < first is not drawn.
        depths: positive float32 depths.
        size_hw: image size, px.
    """
    tiles_y, tiles_x = ((side + TILE - 1) // TILE for side in size_hw)
    # The bits of positive floats order as the floats do.
    keys = np.ascontiguousarray(depths, dtype=np.float32).view(np.uint32)
    return Tiles(tiles_x, *_count(box, keys, tiles_x, tiles_y))
