"""Blending weights of a view as sparse rows, one per pixel, with ascending columns.

The first pass counts the entries of each row; the second writes them. Pixels, blocks, lanes and arguments are
as in `blend`.
"""

from typing import no_type_check

import numpy as np

from hilsplat.base.compiled import compiled
from hilsplat.base.lanes import aligned, keep_gt, lanes, load, store
from hilsplat.splat.rasterise.blend import (
    BLOCKS,
    CHUNK,
    LANES,
    PIXELS,
    RECORD,
    gather,
    start_tile,
    unfinished,
    weigh,
)

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@compiled(inline="always")
@no_type_check
def _place(pixel):
    """Return the column and row of a tile's pixel, relative to the tile's corner."""
    block, lane = pixel // LANES, pixel % LANES
    return (block & 3) * 4 + (lane & 3), (block >> 2) * 4 + (lane >> 2)


@compiled
@no_type_check
def count_weights(
    begin, end, base, tiles_x, tile_start, tile_end, gaussian, reach, size_hw, geometry, least, counts
):
    """Count the weights >= `least` of each pixel (row-major) of tiles begin..end."""
    height, width = size_hw
    transmittance, found = aligned(PIXELS), np.empty(PIXELS, np.int64)
    records = aligned(CHUNK * RECORD)
    entries, by_lane = np.empty(CHUNK, np.int64), aligned(CHUNK * LANES)
    for tile in range(begin, end):
        x0, y0 = start_tile(tile, tiles_x, height, width, transmittance)
        found[:] = 0
        for chunk in range(tile_start[tile], tile_end[tile], CHUNK):
            if unfinished(transmittance) == 0:
                break
            count = min(tile_end[tile] - chunk, CHUNK)
            gather(chunk - base, count, x0, y0, gaussian, geometry, records)
            for block in range(BLOCKS):
                done = weigh(
                    block, chunk - base, count, reach, records, records, 0, transmittance, entries, by_lane
                )[0]
                for n in range(done):
                    for lane in range(LANES):
                        weight = by_lane[n * LANES + lane]
                        found[block * LANES + lane] += (weight > _ZERO) & (weight >= least)
        for pixel in range(PIXELS):
            x, y = _place(pixel)
            if x0 + x < width and y0 + y < height:
                counts[(y0 + y) * width + x0 + x] = found[pixel]


@compiled
@no_type_check
def write_weights(
    begin,
    end,
    base,
    tiles_x,
    tile_start,
    tile_end,
    gaussian,
    reach,
    size_hw,
    geometry,
    least,
    longest,
    row_start,
    columns,
    weights,
):
    """Write the columns and weights of rows counted by `count_weights`, at most `longest` in each."""
    height, width = size_hw
    transmittance, size_of = aligned(PIXELS), np.empty(PIXELS, np.int64)
    records = aligned(CHUNK * RECORD)
    entries, rows = np.empty(CHUNK, np.int64), np.empty(CHUNK, np.int32)
    by_lane = aligned(CHUNK * LANES)
    room = (longest // LANES + 1) * LANES  # a pixel's row and at least one more entry
    held, held_weights = np.empty(PIXELS * room, np.float32), np.empty(PIXELS * room, np.float32)
    held_columns, rank = held.view(np.int32), np.empty(room, np.float32)
    for tile in range(begin, end):
        x0, y0 = start_tile(tile, tiles_x, height, width, transmittance)
        size_of[:] = 0
        for chunk in range(tile_start[tile], tile_end[tile], CHUNK):
            if unfinished(transmittance) == 0:
                break
            count = min(tile_end[tile] - chunk, CHUNK)
            gather(chunk - base, count, x0, y0, gaussian, geometry, records)
            for block in range(BLOCKS):
                done = weigh(
                    block, chunk - base, count, reach, records, records, 0, transmittance, entries, by_lane
                )[0]
                for n in range(done):
                    rows[n] = gaussian[chunk - base + entries[n]]
                for lane in range(LANES if done else 0):
                    pixel = block * LANES + lane
                    at = pixel * room + size_of[pixel]
                    for n in range(done):  # branch-free, because a branch would be unpredictable
                        weight = by_lane[n * LANES + lane]
                        held_columns[at], held_weights[at] = rows[n], weight
                        at += np.int64((weight > _ZERO) & (weight >= least))
                    size_of[pixel] = at - pixel * room
        for pixel in range(PIXELS):
            x, y = _place(pixel)
            if x0 + x >= width or y0 + y >= height:
                continue
            first, size = pixel * room, size_of[pixel]
            _rank(held, first, size, rank)
            start = row_start[(y0 + y) * width + x0 + x]
            for k in range(size):
                at = start + np.int64(rank[k])
                columns[at], weights[at] = held_columns[first + k], held_weights[first + k]


@compiled(inline="always")
@no_type_check
def _rank(held, first, size, rank):
    """Count the smaller columns of each entry of a row; their bits keep their order as floats."""
    for begin in range(0, size, LANES):
        own, smaller = load(held, first + begin), lanes(_ZERO)
        for k in range(first, first + size):
            smaller = smaller + keep_gt(own, lanes(held[k]), lanes(_ONE))
        store(rank, begin, smaller)
