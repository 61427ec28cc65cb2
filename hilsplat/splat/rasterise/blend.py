"""Blending of tile lists into pixels, its gradient, and the blending weights themselves.

A tile is 16x16 pixels in sixteen 4x4 blocks; a block is one vector of 16 lanes. A Gaussian visits
the blocks that its box touches. Lanes outside the image begin with no transmittance.

The backward pass runs front to back and replays the forward pass, so its transmittance is exactly
the forward's. Per pixel it carries one number, R = sum over channels of (what is still to come) x
(gradient); then dL/dalpha = T (colour . gradient) - R / (1 - alpha). Each entry of a tile's list has
its own slot for the sums, so the result does not depend on how tiles are spread over threads.

Alpha is one more channel, of colour 1: the image's alpha is the sum of the weights.

Arguments that the kernels share: tiles begin..end of a row-major grid with `tiles_x` per row; the
list of tile t is gaussian[tile_start[t] - base] .. gaussian[tile_start[t + 1] - base]; geometry and
box as `project` fills them.
"""

from typing import no_type_check

import numpy as np

from hilsplat.base.compiled import compiled
from hilsplat.splat.rasterise.binning import TILE
from hilsplat.splat.rasterise.lanes import (
    any_ge,
    exp2_negative,
    keep_ge,
    keep_gt,
    keep_lt,
    lane_sum,
    lanes,
    load,
    reciprocal,
    smaller,
    store,
)
from hilsplat.splat.rasterise.project import MIN_ALPHA, MOMENTS

MAX_ALPHA = 0.999
"""Alpha of one Gaussian at a pixel is cut here, and passes no gradient beyond (gsplat: 0.999)."""
MIN_TRANSMITTANCE = 1e-4
"""Blending stops at a pixel before the Gaussian that would leave less light than this (3DGS, gsplat)."""
CHECK_EVERY = 8
"""Gaussians between two checks for finished blocks."""

_CUT = np.float32(np.log2(MIN_ALPHA))
_TOP = np.float32(MAX_ALPHA)
_STOP = np.float32(MIN_TRANSMITTANCE)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_X = np.tile(np.arange(4, dtype=np.float32) + np.float32(0.5), 4)
_Y = np.repeat(np.arange(4, dtype=np.float32) + np.float32(0.5), 4)
BLOCKS = 16
LANES = 16
PIXELS = BLOCKS * LANES


@compiled(inline="always")
@no_type_check
def _start_tile(tile, tiles_x, height, width, transmittance, alive):
    """Full transmittance in the pixels inside the image; returns the tile's corner."""
    x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    for block in range(BLOCKS):
        alive[block] = False
        for lane in range(LANES):
            x, y = _pixel(x0, y0, block, lane)
            inside = x < width and y < height
            transmittance[block * LANES + lane] = 1.0 if inside else 0.0
            alive[block] = alive[block] or inside
    return x0, y0


@compiled(inline="always")
@no_type_check
def _pixel(x0, y0, block, lane):
    """Column and row of a lane's pixel."""
    return x0 + (block % 4) * 4 + lane % 4, y0 + (block // 4) * 4 + lane // 4


@compiled(inline="always")
@no_type_check
def _any_alive(transmittance, alive):
    """Mark finished blocks; returns whether any block is unfinished."""
    some = False
    for block in range(BLOCKS):
        if alive[block]:
            alive[block] = any_ge(load(transmittance, block * LANES), lanes(_STOP))
            some = some or alive[block]
    return some


@compiled(inline="always")
@no_type_check
def _blocks(box, i, x0, y0):
    """First and last block row, first and last block column of the tile that a Gaussian's box touches."""
    return (
        max(box[i, 2] - y0, 0) >> 2,
        min(box[i, 3] - y0, TILE - 1) >> 2,
        max(box[i, 0] - x0, 0) >> 2,
        min(box[i, 1] - x0, TILE - 1) >> 2,
    )


@compiled(inline="always")
@no_type_check
def _place(geometry, i, x0, y0):
    """Mean of a Gaussian from the tile's corner, and a, b, c, log2 of the peak alpha in all lanes."""
    mean_x = np.float32(geometry[i, 0] - np.float32(x0))
    mean_y = np.float32(geometry[i, 1] - np.float32(y0))
    a, b, c = lanes(geometry[i, 2]), lanes(geometry[i, 3]), lanes(geometry[i, 4])
    return mean_x, mean_y, a, b, c, lanes(geometry[i, 5])


@compiled(inline="always")
@no_type_check
def _to_mean(mean, at, centres):
    """Distances from a block's pixel centres to the mean along an axis; `at` counts blocks."""
    return lanes(np.float32(mean - np.float32(4 * at))) - centres


@compiled(inline="always")
@no_type_check
def _shine(exponent, transmittance, block):
    """Blend a Gaussian into a block and reduce its transmittance; returns uncut alpha, alpha and weight."""
    uncut = exp2_negative(exponent)
    alpha = keep_ge(exponent, lanes(_CUT), smaller(uncut, lanes(_TOP)))
    light = load(transmittance, block * LANES)
    weight = light * alpha
    left = light - weight
    store(transmittance, block * LANES, keep_gt(left, lanes(_STOP), left))
    return uncut, alpha, keep_gt(left, lanes(_STOP), weight)


@compiled
@no_type_check
def blend(begin, end, base, tiles_x, tile_start, gaussian, geometry, box, colours, image, alpha):
    """Blend tiles: image (H, W, C) gets the premultiplied channels, alpha (H, W) the coverage."""
    height, width, channels = image.shape
    transmittance = np.empty(PIXELS, np.float32)
    sums = np.empty(PIXELS * (channels + 1), np.float32)
    alive = np.empty(BLOCKS, np.bool_)
    px, py = load(_X, 0), load(_Y, 0)
    stride = LANES * (channels + 1)
    for tile in range(begin, end):
        x0, y0 = _start_tile(tile, tiles_x, height, width, transmittance, alive)
        sums[:] = 0.0
        for entry in range(tile_start[tile], tile_start[tile + 1]):
            if (entry - tile_start[tile]) % CHECK_EVERY == 0 and not _any_alive(transmittance, alive):
                break
            i = gaussian[entry - base]
            row0, row1, column0, column1 = _blocks(box, i, x0, y0)
            mean_x, mean_y, a, b, c, top = _place(geometry, i, x0, y0)
            for row in range(row0, row1 + 1):
                dy = _to_mean(mean_y, row, py)
                peak, slope = top - c * dy * dy, b * dy
                for column in range(column0, column1 + 1):
                    block = row * 4 + column
                    if not alive[block]:
                        continue
                    dx = _to_mean(mean_x, column, px)
                    exponent = peak - dx * (a * dx + slope)
                    if not any_ge(exponent, lanes(_CUT)):
                        continue
                    _, _, weight = _shine(exponent, transmittance, block)
                    at = block * stride
                    store(sums, at, load(sums, at) + weight)
                    for channel in range(channels):
                        at += LANES
                        store(sums, at, load(sums, at) + weight * lanes(colours[i, channel]))
        for block in range(BLOCKS):
            for lane in range(LANES):
                x, y = _pixel(x0, y0, block, lane)
                if x < width and y < height:
                    at = block * stride + lane
                    alpha[y, x] = sums[at]
                    for channel in range(channels):
                        image[y, x, channel] = sums[at + LANES * (channel + 1)]


@compiled(inline="always")
@no_type_check
def _load_gradients(x0, y0, stride, image, alpha, grad_image, grad_alpha, grads, to_come):
    """Gradients of a tile's pixels by block and channel, and R before the first Gaussian."""
    height, width, channels = image.shape
    for block in range(BLOCKS):
        for lane in range(LANES):
            x, y = _pixel(x0, y0, block, lane)
            at = block * stride + lane
            total = _ZERO
            if x < width and y < height:
                grads[at] = grad_alpha[y, x]
                total = alpha[y, x] * grad_alpha[y, x]
                for channel in range(channels):
                    grads[at + LANES * (channel + 1)] = grad_image[y, x, channel]
                    total += image[y, x, channel] * grad_image[y, x, channel]
            else:
                for channel in range(channels + 1):
                    grads[at + LANES * channel] = 0.0
            to_come[block * LANES + lane] = total


@compiled
@no_type_check
def blend_backward(
    begin,
    end,
    base,
    tiles_x,
    tile_start,
    gaussian,
    geometry,
    box,
    colours,
    image,
    alpha,
    grad_image,
    grad_alpha,
    slots,
):
    """Gradient of `blend`, into one slot per entry of the lists: slots[entry - base].

    A slot holds the moments of v = alpha dL/dalpha (see MOMENTS), then dL/dcolour per channel; those
    of entries behind finished pixels are zeros.
    """
    height, width, channels = image.shape
    transmittance = np.empty(PIXELS, np.float32)
    to_come = np.empty(PIXELS, np.float32)
    grads = np.empty(PIXELS * (channels + 1), np.float32)
    colour_sums = np.empty(LANES * channels, np.float32)
    alive = np.empty(BLOCKS, np.bool_)
    px, py = load(_X, 0), load(_Y, 0)
    zero = lanes(_ZERO)
    stride = LANES * (channels + 1)
    for tile in range(begin, end):
        x0, y0 = _start_tile(tile, tiles_x, height, width, transmittance, alive)
        _load_gradients(x0, y0, stride, image, alpha, grad_image, grad_alpha, grads, to_come)
        finished = False
        for entry in range(tile_start[tile], tile_start[tile + 1]):
            slot = entry - base
            if not finished and (entry - tile_start[tile]) % CHECK_EVERY == 0:
                finished = not _any_alive(transmittance, alive)
            if finished:
                slots[slot, :] = 0.0
                continue
            i = gaussian[slot]
            row0, row1, column0, column1 = _blocks(box, i, x0, y0)
            mean_x, mean_y, a, b, c, top = _place(geometry, i, x0, y0)
            s, sx, sy, sxx, sxy, syy = zero, zero, zero, zero, zero, zero
            red, green, blue = zero, zero, zero
            if channels != 3:
                colour_sums[:] = 0.0
            for row in range(row0, row1 + 1):
                dy = _to_mean(mean_y, row, py)
                peak, slope = top - c * dy * dy, b * dy
                for column in range(column0, column1 + 1):
                    block = row * 4 + column
                    if not alive[block]:
                        continue
                    dx = _to_mean(mean_x, column, px)
                    exponent = peak - dx * (a * dx + slope)
                    if not any_ge(exponent, lanes(_CUT)):
                        continue
                    uncut, here, weight = _shine(exponent, transmittance, block)
                    at = block * stride
                    shade = load(grads, at)
                    if channels == 3:  # colour sums in registers: a fifth faster
                        by_red = load(grads, at + LANES)
                        by_green = load(grads, at + 2 * LANES)
                        by_blue = load(grads, at + 3 * LANES)
                        red = red + weight * by_red
                        green = green + weight * by_green
                        blue = blue + weight * by_blue
                        shade = shade + by_red * lanes(colours[i, 0])
                        shade = shade + by_green * lanes(colours[i, 1]) + by_blue * lanes(colours[i, 2])
                    else:
                        for channel in range(channels):
                            grad = load(grads, at + LANES * (channel + 1))
                            shade = shade + grad * lanes(colours[i, channel])
                            spot = LANES * channel
                            store(colour_sums, spot, load(colour_sums, spot) + weight * grad)
                    seen = weight * shade
                    rest = load(to_come, block * LANES) - seen
                    store(to_come, block * LANES, rest)
                    v = seen - rest * here * reciprocal(lanes(_ONE) - here)
                    v = keep_lt(uncut, lanes(_TOP), keep_gt(weight, zero, v))
                    vx, vy = v * dx, v * dy
                    s = s + v
                    sx = sx + vx
                    sy = sy + vy
                    sxx = sxx + vx * dx
                    sxy = sxy + vx * dy
                    syy = syy + vy * dy
            slots[slot, 0], slots[slot, 1], slots[slot, 2] = lane_sum(s), lane_sum(sx), lane_sum(sy)
            slots[slot, 3], slots[slot, 4], slots[slot, 5] = lane_sum(sxx), lane_sum(sxy), lane_sum(syy)
            if channels == 3:
                store(colour_sums, 0, red)
                store(colour_sums, LANES, green)
                store(colour_sums, 2 * LANES, blue)
            for channel in range(channels):
                slots[slot, MOMENTS + channel] = lane_sum(load(colour_sums, LANES * channel))


@compiled
@no_type_check
def add_slots(begin, end, gaussian, slots, sums):
    """Add the slots of Gaussians begin..end to their sums, in the order of the entries."""
    for entry in range(len(gaussian)):
        i = gaussian[entry]
        if begin <= i < end:
            for k in range(slots.shape[1]):
                sums[i, k] += slots[entry, k]


@compiled
@no_type_check
def blend_weights(
    begin, end, base, tiles_x, size_hw, tile_start, gaussian, geometry, box, least, cursor, columns, weights
):
    """Weights of tiles as sparse rows, one row per pixel (row-major).

    Called twice. With empty `columns` it counts: cursor[pixel] grows by one per weight >= least.
    Then, with cursor at the beginning of each row, it fills columns and weights front to back.
    """
    height, width = size_hw
    count_only = len(columns) == 0
    transmittance = np.empty(PIXELS, np.float32)
    buffer = np.empty(LANES, np.float32)
    alive = np.empty(BLOCKS, np.bool_)
    px, py = load(_X, 0), load(_Y, 0)
    for tile in range(begin, end):
        x0, y0 = _start_tile(tile, tiles_x, height, width, transmittance, alive)
        for entry in range(tile_start[tile], tile_start[tile + 1]):
            if (entry - tile_start[tile]) % CHECK_EVERY == 0 and not _any_alive(transmittance, alive):
                break
            i = gaussian[entry - base]
            row0, row1, column0, column1 = _blocks(box, i, x0, y0)
            mean_x, mean_y, a, b, c, top = _place(geometry, i, x0, y0)
            for row in range(row0, row1 + 1):
                dy = _to_mean(mean_y, row, py)
                peak, slope = top - c * dy * dy, b * dy
                for column in range(column0, column1 + 1):
                    block = row * 4 + column
                    if not alive[block]:
                        continue
                    dx = _to_mean(mean_x, column, px)
                    exponent = peak - dx * (a * dx + slope)
                    if not any_ge(exponent, lanes(_CUT)):
                        continue
                    _, _, weight = _shine(exponent, transmittance, block)
                    if not any_ge(weight, lanes(least)):
                        continue
                    store(buffer, 0, weight)
                    for lane in range(LANES):
                        if buffer[lane] > _ZERO and buffer[lane] >= least:
                            x, y = _pixel(x0, y0, block, lane)
                            at = cursor[y * width + x]
                            cursor[y * width + x] = at + 1
                            if not count_only:
                                columns[at] = i
                                weights[at] = buffer[lane]


@compiled
@no_type_check
def sort_rows(begin, end, row_start, columns, weights):
    """Sort the entries of sparse rows begin..end by column (insertion sort; rows are short)."""
    for row in range(begin, end):
        for k in range(row_start[row] + 1, row_start[row + 1]):
            column, weight = columns[k], weights[k]
            at = k
            while at > row_start[row] and columns[at - 1] > column:
                columns[at], weights[at] = columns[at - 1], weights[at - 1]
                at -= 1
            columns[at], weights[at] = column, weight
