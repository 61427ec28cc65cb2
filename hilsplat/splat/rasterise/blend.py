"""Blending of tile lists into pixels, its gradient, and the blending weights themselves.

A tile is 16x16 pixels in sixteen 4x4 blocks; a block is one vector of 16 lanes. Lanes outside the image
begin with no transmittance. A list is taken CHUNK entries at a time: their Gaussians are copied beside
each other, with a bit for each block that they can reach (the sixteen blocks, too, are one vector).
Forward, block by block then blends its own Gaussians with its sums in registers; backward, Gaussian by
Gaussian gathers its gradient over its blocks.

The backward pass runs front to back and replays the forward pass, so its transmittance is exactly
the forward's. Per pixel it carries one number, R = sum over channels of (what is still to come) x
(gradient); then dL/dalpha = T (colour . gradient) - R / (1 - alpha). Each entry of a tile's list has
its own slot for the sums, so the result does not depend on how tiles are spread over threads.

Alpha is one more channel, of colour 1: the image's alpha is the sum of the weights.

Arguments that the kernels share: tiles begin..end of a row-major grid with `tiles_x` per row; the
list of tile t is gaussian[tile_start[t] - base] .. gaussian[tile_start[t + 1] - base]; geometry as
`project` fills it.
"""

from typing import no_type_check

import numpy as np

from hilsplat.base.compiled import compiled
from hilsplat.base.lanes import (
    any_ge,
    bits_ge,
    exp2_negative,
    first_bit,
    keep_ge,
    keep_gt,
    keep_lt,
    lane_sum,
    lanes,
    larger,
    load,
    reciprocal,
    smaller,
    store,
    store_sums,
)
from hilsplat.splat.rasterise.binning import TILE
from hilsplat.splat.rasterise.project import MIN_ALPHA, MOMENTS

MAX_ALPHA = 0.999
"""Alpha of one Gaussian at a pixel is cut here, and passes no gradient beyond (gsplat: 0.999)."""
MIN_TRANSMITTANCE = 1e-4
"""Blending stops at a pixel before the Gaussian that would leave less light than this (3DGS, gsplat)."""
CHECK_EVERY = 8
"""Gaussians between two checks for finished blocks."""
CHUNK = 128
"""Entries of a list that are copied beside each other: with their lists, 40 kB for 3 channels."""
REACH_SLACK = (1e-2, 1e-6)
"""A block is left out if the exponent misses the cut by more than this: absolute, and relative to the
squares that the exponent is the difference of (float32 has 6e-8)."""

_CUT = np.float32(np.log2(MIN_ALPHA))
_TOP = np.float32(MAX_ALPHA)
_STOP = np.float32(MIN_TRANSMITTANCE)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_SLACK, _RELATIVE = np.float32(REACH_SLACK[0]), np.float32(REACH_SLACK[1])
BLOCKS = 16
LANES = 16
PIXELS = BLOCKS * LANES
RECORD = 8
"""Numbers of a copied Gaussian: mean x, mean y from the tile's corner, a, b, c, log2 of the peak alpha."""
GROUP = 4
"""Channels that are summed in registers at a time."""

_NUMBERS = np.arange(BLOCKS, dtype=np.float32)
_LEFT = 4 * (_NUMBERS % 4) + np.float32(0.5)
_UPPER = 4 * (_NUMBERS // 4) + np.float32(0.5)
"""Centres of each block's first pixel, from the tile's corner."""
_X = np.repeat(_LEFT, LANES) + np.tile(_NUMBERS % 4, BLOCKS)
_Y = np.repeat(_UPPER, LANES) + np.tile(_NUMBERS // 4, BLOCKS)
"""Centres of all pixels of a tile, block by block."""
_SPAN = np.float32(3.0)
"""From a block's first pixel centre to its last."""


@compiled(inline="always")
@no_type_check
def start_tile(tile, tiles_x, height, width, transmittance):
    """Full transmittance in the pixels inside the image; returns the tile's corner."""
    x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    right, bottom = lanes(np.float32(width - x0)), lanes(np.float32(height - y0))
    for block in range(BLOCKS):
        inside = keep_lt(load(_X, block * LANES), right, lanes(_ONE))
        store(transmittance, block * LANES, keep_lt(load(_Y, block * LANES), bottom, inside))
    return x0, y0


@compiled(inline="always")
@no_type_check
def unfinished(transmittance):
    """Bits of the blocks that are unfinished."""
    bits = 0
    for block in range(BLOCKS):
        if any_ge(load(transmittance, block * LANES), lanes(_STOP)):
            bits |= 1 << block
    return bits


@compiled(inline="always")
@no_type_check
def _least(a, b, c, u, v):
    """Lower bound, for rounding, of a u^2 + b u v + c v^2."""
    uu, vv = a * u * u, c * v * v
    return uu + b * u * v + vv - lanes(_RELATIVE) * (uu + vv)


@compiled(inline="always")
@no_type_check
def _reach(mean_x, mean_y, a, b, c, top):
    """Bits of the blocks in which a Gaussian's alpha can reach MIN_ALPHA.

    The least exponent over a block is that at the mean, if the block holds it, else on one of the edges
    that face the mean: there it is least where its slope along the edge is zero, or at the nearer corner.
    """
    left, upper = load(_LEFT, 0) - lanes(mean_x), load(_UPPER, 0) - lanes(mean_y)
    right, lower = left + lanes(_SPAN), upper + lanes(_SPAN)
    zero = lanes(_ZERO)
    u, v = smaller(larger(zero, left), right), smaller(larger(zero, upper), lower)
    half_b = np.float32(0.5) * b
    along_v = smaller(larger(lanes(-half_b / c) * u, upper), lower)
    along_u = smaller(larger(lanes(-half_b / a) * v, left), right)
    a, b, c = lanes(a), lanes(b), lanes(c)
    least = smaller(_least(a, b, c, u, along_v), _least(a, b, c, along_u, v))
    return bits_ge(lanes(top + _SLACK) - least, lanes(_CUT))


@compiled(inline="always")
@no_type_check
def gather(first, count, x0, y0, gaussian, geometry, records, reach):
    """Copy the Gaussians of entries first..first + count of the band, and the blocks that they reach."""
    for k in range(count):
        i = gaussian[first + k]
        mean_x = np.float32(geometry[i, 0] - np.float32(x0))
        mean_y = np.float32(geometry[i, 1] - np.float32(y0))
        a, b, c, top = geometry[i, 2], geometry[i, 3], geometry[i, 4], geometry[i, 5]
        at = k * RECORD
        records[at], records[at + 1] = mean_x, mean_y
        records[at + 2], records[at + 3], records[at + 4], records[at + 5] = a, b, c, top
        reach[k] = _reach(mean_x, mean_y, a, b, c, top)


@compiled(inline="always")
@no_type_check
def _exponent(records, at, px, py):
    """Distances of a copied Gaussian to pixel centres, and log2 of its uncut alpha there."""
    dx, dy = lanes(records[at]) - px, lanes(records[at + 1]) - py
    slope = lanes(records[at + 3]) * dy
    peak = lanes(records[at + 5]) - lanes(records[at + 4]) * dy * dy
    return dx, dy, peak - dx * (lanes(records[at + 2]) * dx + slope)


@compiled(inline="always")
@no_type_check
def _shine(exponent, light):
    """Uncut alpha, alpha and weight of a Gaussian where `light` is left, and the light behind it."""
    uncut = exp2_negative(exponent)
    alpha = keep_ge(exponent, lanes(_CUT), smaller(uncut, lanes(_TOP)))
    weight = light * alpha
    left = light - weight
    return uncut, alpha, keep_gt(left, lanes(_STOP), weight), keep_gt(left, lanes(_STOP), left)


@compiled(inline="always")
@no_type_check
def list_block(block, count, reach, entries):
    """Which Gaussians of a chunk reach a block, front to back; returns how many."""
    size = 0
    for k in range(count):  # without a branch, which the processor could not foresee
        entries[size] = k
        size += (reach[k] >> block) & 1
    return size


@compiled(inline="always")
@no_type_check
def weigh(block, size, records, entries, shades, width, transmittance, weights):
    """Weights of a block's Gaussians, front to back, and its transmittance behind them.

    Args:
        shades: the channels of Gaussian k begin at k * width.

    Returns:
        how many were weighed before all pixels were finished, and the sums of the first 4 channels.
    """
    light = load(transmittance, block * LANES)
    px, py = load(_X, block * LANES), load(_Y, block * LANES)
    done = size
    one, two, three, four = lanes(_ZERO), lanes(_ZERO), lanes(_ZERO), lanes(_ZERO)
    for n in range(size):
        k = entries[n]
        _, _, exponent = _exponent(records, k * RECORD, px, py)
        _, _, weight, light = _shine(exponent, light)
        store(weights, n * LANES, weight)
        one = one + weight * lanes(shades[k * width])
        two = two + weight * lanes(shades[k * width + 1])
        three = three + weight * lanes(shades[k * width + 2])
        four = four + weight * lanes(shades[k * width + 3])
        if n % CHECK_EVERY == CHECK_EVERY - 1 and not any_ge(light, lanes(_STOP)):
            done = n + 1
            break
    store(transmittance, block * LANES, light)
    return done, one, two, three, four


@compiled(inline="always")
@no_type_check
def _add_group(sums, at, one, two, three, four):
    """Add to the sums of 4 channels."""
    store(sums, at, load(sums, at) + one)
    store(sums, at + LANES, load(sums, at + LANES) + two)
    store(sums, at + 2 * LANES, load(sums, at + 2 * LANES) + three)
    store(sums, at + 3 * LANES, load(sums, at + 3 * LANES) + four)


@compiled
@no_type_check
def blend(begin, end, base, tiles_x, tile_start, gaussian, geometry, colours, image, alpha):
    """Blend tiles: image (H, W, C) gets the premultiplied channels, alpha (H, W) the coverage."""
    height, width, channels = image.shape
    per_gaussian = (channels + GROUP) // GROUP * GROUP
    stride = LANES * per_gaussian
    transmittance = np.empty(PIXELS, np.float32)
    sums = np.empty(BLOCKS * stride, np.float32)
    records, reach = np.empty(CHUNK * RECORD, np.float32), np.empty(CHUNK, np.int64)
    shades = np.zeros(CHUNK * per_gaussian, np.float32)
    shades[::per_gaussian] = 1.0
    entries, weights = np.empty(CHUNK, np.int64), np.empty(CHUNK * LANES, np.float32)
    for tile in range(begin, end):
        x0, y0 = start_tile(tile, tiles_x, height, width, transmittance)
        sums[:] = 0.0
        for chunk in range(tile_start[tile], tile_start[tile + 1], CHUNK):
            alive = unfinished(transmittance)
            if alive == 0:
                break
            count = min(tile_start[tile + 1] - chunk, CHUNK)
            gather(chunk - base, count, x0, y0, gaussian, geometry, records, reach)
            for k in range(count):
                i = gaussian[chunk - base + k]
                for channel in range(channels):
                    shades[k * per_gaussian + 1 + channel] = colours[i, channel]
            for block in range(BLOCKS):
                if not (alive >> block) & 1:
                    continue
                size = list_block(block, count, reach, entries)
                done, one, two, three, four = weigh(
                    block, size, records, entries, shades, per_gaussian, transmittance, weights
                )
                _add_group(sums, block * stride, one, two, three, four)
                for group in range(GROUP, per_gaussian, GROUP):
                    one, two, three, four = lanes(_ZERO), lanes(_ZERO), lanes(_ZERO), lanes(_ZERO)
                    for n in range(done):
                        weight = load(weights, n * LANES)
                        shade = entries[n] * per_gaussian + group
                        one = one + weight * lanes(shades[shade])
                        two = two + weight * lanes(shades[shade + 1])
                        three = three + weight * lanes(shades[shade + 2])
                        four = four + weight * lanes(shades[shade + 3])
                    _add_group(sums, block * stride + group * LANES, one, two, three, four)
        for y in range(y0, min(y0 + TILE, height)):
            for x in range(x0, min(x0 + TILE, width)):
                at = _spot(x - x0, y - y0, stride)
                alpha[y, x] = sums[at]
                for channel in range(channels):
                    image[y, x, channel] = sums[at + LANES * (channel + 1)]


@compiled(inline="always")
@no_type_check
def _spot(x, y, stride):
    """Place of a tile's pixel among blocks of `stride` numbers."""
    return ((y >> 2) * 4 + (x >> 2)) * stride + (y & 3) * 4 + (x & 3)


@compiled(inline="always")
@no_type_check
def _load_gradients(x0, y0, stride, image, alpha, grad_image, grad_alpha, grads, to_come):
    """Gradients of a tile's pixels by block and channel, and R before the first Gaussian."""
    height, width, channels = image.shape
    if x0 + TILE > width or y0 + TILE > height:
        grads[:] = 0.0
        to_come[:] = 0.0
    for y in range(y0, min(y0 + TILE, height)):
        for x in range(x0, min(x0 + TILE, width)):
            at = _spot(x - x0, y - y0, stride)
            grads[at] = grad_alpha[y, x]
            total = alpha[y, x] * grad_alpha[y, x]
            for channel in range(channels):
                grads[at + LANES * (channel + 1)] = grad_image[y, x, channel]
                total += image[y, x, channel] * grad_image[y, x, channel]
            to_come[_spot(x - x0, y - y0, LANES)] = total


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
    stride = LANES * (channels + 1)
    grads = np.empty(BLOCKS * stride, np.float32)
    colour_sums = np.empty(LANES * channels, np.float32)
    records, reach = np.empty(CHUNK * RECORD, np.float32), np.empty(CHUNK, np.int64)
    flat_slots, columns = slots.reshape(-1), slots.shape[1]
    zero = lanes(_ZERO)
    for tile in range(begin, end):
        x0, y0 = start_tile(tile, tiles_x, height, width, transmittance)
        _load_gradients(x0, y0, stride, image, alpha, grad_image, grad_alpha, grads, to_come)
        alive = unfinished(transmittance)
        for chunk in range(tile_start[tile], tile_start[tile + 1], CHUNK):
            count = min(tile_start[tile + 1] - chunk, CHUNK)
            if alive == 0:
                slots[chunk - base : chunk - base + count, :] = 0.0
                continue
            gather(chunk - base, count, x0, y0, gaussian, geometry, records, reach)
            for k in range(count):
                slot = chunk - base + k
                if k % CHECK_EVERY == 0:
                    alive = unfinished(transmittance)
                bits = reach[k] & alive
                if bits == 0:
                    for column in range(columns):
                        slots[slot, column] = 0.0
                    continue
                i = gaussian[slot]
                s, sx, sy, sxx, sxy, syy = zero, zero, zero, zero, zero, zero
                red, green, blue = zero, zero, zero
                if channels != 3:
                    colour_sums[:] = 0.0
                while bits != 0:
                    block = first_bit(bits)
                    bits &= bits - 1
                    spot = block * LANES
                    dx, dy, exponent = _exponent(records, k * RECORD, load(_X, spot), load(_Y, spot))
                    uncut, here, weight, left = _shine(exponent, load(transmittance, spot))
                    store(transmittance, spot, left)
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
                            to = LANES * channel
                            store(colour_sums, to, load(colour_sums, to) + weight * grad)
                    seen = weight * shade
                    rest = load(to_come, spot) - seen
                    store(to_come, spot, rest)
                    v = seen - rest * here * reciprocal(lanes(_ONE) - here)
                    v = keep_lt(uncut, lanes(_TOP), keep_gt(weight, zero, v))
                    vx, vy = v * dx, v * dy
                    s = s + v
                    sx = sx + vx
                    sy = sy + vy
                    sxx = sxx + vx * dx
                    sxy = sxy + vx * dy
                    syy = syy + vy * dy
                at = slot * columns
                if channels == 3:
                    store_sums(flat_slots, at, (s, sx, sy, sxx, sxy, syy, red, green, blue))
                else:
                    store_sums(flat_slots, at, (s, sx, sy, sxx, sxy, syy))
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
