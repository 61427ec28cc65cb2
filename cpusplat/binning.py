"""Depth order and tile lists of a view: the Gaussians that each 16x16 tile blends, front to back."""

from dataclasses import dataclass

import numpy as np

from cpusplat.compiled import compiled
from cpusplat.lanes import bits_ge, lanes, larger, load, prefetch, smaller
from cpusplat.project import MIN_ALPHA

TILE = 16  # side of a tile, px
BLOCK_X = np.tile(np.arange(4, dtype=np.float32) * 4, 4) + np.float32(0.5)
BLOCK_Y = np.repeat(np.arange(4, dtype=np.float32) * 4, 4) + np.float32(0.5)
"""Centre of the first pixel of each 4x4 block, relative to the tile's corner."""
_SLACK, _RELATIVE = np.float32(1e-2), np.float32(1e-6)
"""A block is skipped if the exponent is below the cut by more than the sum of an absolute slack and a slack
proportional to the squared terms of the exponent (float32 rounding: 6e-8)."""
AHEAD = 16  # rows are prefetched this many list entries ahead
MAX_ENTRIES = 2**22
"""Maximum number of tile list entries in memory: 16 MiB, and 144 MiB of gradients for 3 channels."""

_SPAN = np.float32(3.0)  # distance between a block's first and last pixel centres
_CUT = np.float32(np.log2(MIN_ALPHA))


@dataclass(frozen=True)
class Tiles:
    """Depth order and list sizes from which a view's tile lists are built.

    The tile in row y and column x has index t = y * tiles_x + x. Its list contains Gaussians whose box
    touches the tile, front to back, in at most tile_start[t + 1] - tile_start[t] entries.
    """

    tiles_x: int
    order: np.ndarray  # int32 [M], rows of the drawn Gaussians, front to back; ties in row order
    tile_start: np.ndarray  # int64 [tiles + 1], number of entries in all preceding tiles

    def bands(self) -> list[tuple[int, int]]:
        """Return ranges that cover all tiles, each with at most `MAX_ENTRIES` entries or a single tile."""
        start, out, begin = self.tile_start, [], 0
        while begin < len(start) - 1:
            end = int(np.searchsorted(start, start[begin] + MAX_ENTRIES, side="right")) - 1
            end = min(max(end, begin + 1), len(start) - 1)
            out.append((begin, end))
            begin = end
        return out


@compiled
def _depth_order(rows, keys):
    """Return rows by ascending uint32 keys: stable least-significant-digit radix sort, 3 x 11 bits."""
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
def _count(box, keys, tiles_x, tiles_y):
    """Return the depth order of drawn Gaussians and each tile's list start (prefix sums of box corners)."""
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


@compiled(inline="always")
def _least(a, b, c, u, v):
    """Return a lower bound of a u^2 + b u v + c v^2 that allows for rounding."""
    uu, vv = a * u * u, c * v * v
    return uu + b * u * v + vv - lanes(_RELATIVE) * (uu + vv)


@compiled(inline="always")
def _reach(mean_x, mean_y, a, b, c, top, along_x, along_y):
    """Return the bits of the blocks in which a Gaussian's alpha can reach MIN_ALPHA.

    The quadratic form's minimum over a block is at the mean if the block contains the mean. Otherwise it is
    on an edge that faces the mean: where the slope along the edge is zero (along_x v and along_y u from the
    mean), or at the nearer corner.
    """
    left, upper = load(BLOCK_X, 0) - lanes(mean_x), load(BLOCK_Y, 0) - lanes(mean_y)
    right, lower = left + lanes(_SPAN), upper + lanes(_SPAN)
    zero = lanes(np.float32(0))
    u, v = smaller(larger(zero, left), right), smaller(larger(zero, upper), lower)
    along_v = smaller(larger(lanes(along_y) * u, upper), lower)
    along_u = smaller(larger(lanes(along_x) * v, left), right)
    a, b, c = lanes(a), lanes(b), lanes(c)
    least = smaller(_least(a, b, c, u, along_v), _least(a, b, c, along_u, v))
    return bits_ge(lanes(top + _SLACK) - least, lanes(_CUT))


@compiled(error_model="numpy")  # a and c may be 0: such a Gaussian covers the view evenly
def fill_lists(begin, end, base, tiles_x, order, tile_start, box, geometry, gaussian, reach, tile_end):
    """Write the lists of tiles begin..end and their ends; entry e is written to gaussian[e - base].

    reach[e - base] has a bit for each block that the Gaussian can reach; if it reaches none, it is omitted.
    """
    tile_end[begin:end] = tile_start[begin:end]
    for k in range(len(order)):
        ahead = order[min(k + AHEAD, len(order) - 1)]
        prefetch(geometry, ahead * geometry.shape[1])
        prefetch(box, ahead * 4)
        i = order[k]
        x0, x1 = box[i, 0] // TILE, box[i, 1] // TILE + 1
        y0, y1 = max(box[i, 2] // TILE, begin // tiles_x), box[i, 3] // TILE + 1
        a, b, c, top = geometry[i, 2], geometry[i, 3], geometry[i, 4], geometry[i, 5]
        along_x, along_y = np.float32(-0.5) * b / a, np.float32(-0.5) * b / c
        for y in range(y0, min(y1, (end - 1) // tiles_x + 1)):
            mean_y = np.float32(geometry[i, 1] - np.float32(y * TILE))
            for tile in range(max(y * tiles_x + x0, begin), min(y * tiles_x + x1, end)):
                mean_x = np.float32(geometry[i, 0] - np.float32((tile - y * tiles_x) * TILE))
                bits = _reach(mean_x, mean_y, a, b, c, top, along_x, along_y)
                entry = tile_end[tile] - base
                gaussian[entry], reach[entry] = i, bits
                tile_end[tile] += np.int64(bits != 0)


def bin_gaussians(box: np.ndarray, depths: np.ndarray, size_hw: tuple[int, int]) -> Tiles:
    """Sort the drawn Gaussians by depth (positive float32) and count them per tile.

    `box` (int32 [N, 4]) contains the first and last pixel columns, then rows; last < first for Gaussians that
    are not drawn.
    """
    tiles_y, tiles_x = ((side + TILE - 1) // TILE for side in size_hw)
    # positive floats and their bits have the same order
    keys = np.ascontiguousarray(depths, dtype=np.float32).view(np.uint32)
    return Tiles(tiles_x, *_count(box, keys, tiles_x, tiles_y))
