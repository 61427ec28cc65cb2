"""Blending of tile lists into pixels, its gradient, and the blending weights.

A tile is 16x16 pixels in sixteen 4x4 blocks; a block is one vector of 16 lanes. Lanes outside the image
start with zero transmittance. Lists are processed in chunks of CHUNK entries, whose Gaussians are copied to
contiguous memory; each entry has a bit for every block that it can reach (the sixteen blocks are also one
vector). The forward pass blends each block's own Gaussians and keeps the sums in registers. The backward pass
sums the gradient of each Gaussian over its blocks.

The backward pass runs front to back and repeats the forward pass, so both have exactly the same
transmittance. It keeps one number per pixel, R = sum over channels of (contribution of the remaining
Gaussians) x (gradient); then dL/dalpha = T (colour . gradient) - R / (1 - alpha). Each list entry has
its own slot for the sums, so the result does not depend on the distribution of tiles over threads.

Alpha is an additional channel with colour 1: the image's alpha is the sum of the weights. Sparse rows of
weights need two passes: the first counts the entries of each row, and the second writes them.

Arguments shared by the kernels: tiles begin..end of a row-major grid with `tiles_x` per row; the list
of tile t is gaussian[tile_start[t] - base] .. gaussian[tile_end[t] - base]; geometry as written by
`project`.
"""

import numpy as np

from cpusplat.binning import AHEAD, BLOCK_X, BLOCK_Y, TILE
from cpusplat.compiled import compiled
from cpusplat.lanes import (
    aligned,
    any_ge,
    column_bits,
    exp2_negative,
    first_bit,
    keep_ge,
    keep_gt,
    keep_lt,
    lane_sum,
    lanes,
    load,
    load_same,
    prefetch,
    reciprocal,
    smaller,
    store,
    store_sums,
)
from cpusplat.project import MIN_ALPHA, MOMENTS

MAX_ALPHA = 0.999  # maximum alpha of a Gaussian at a pixel; clipped alphas pass no gradient (gsplat: 0.999)
MIN_TRANSMITTANCE = 1e-4
"""Blending stops at a pixel before the Gaussian that would reduce transmittance below this (3DGS, gsplat)."""
CHUNK = 128  # number of list entries copied at once; with their lists, they take 40 kB for 3 channels
_CUT = np.float32(np.log2(MIN_ALPHA))
_TOP = np.float32(MAX_ALPHA)
_STOP = np.float32(MIN_TRANSMITTANCE)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
BLOCKS = 16
LANES = 16
PIXELS = BLOCKS * LANES
RECORD = 8
"""Numbers per copied Gaussian: mean x and y from the tile's corner, a, b, c, log2 of peak alpha, 2 spare."""
GROUP = 4  # number of channels that are summed together in registers

_NUMBERS = np.arange(LANES, dtype=np.float32)
_X = np.repeat(BLOCK_X, LANES) + np.tile(_NUMBERS % 4, BLOCKS)
_Y = np.repeat(BLOCK_Y, LANES) + np.tile(_NUMBERS // 4, BLOCKS)
"""Pixel centres of a tile, block by block."""


@compiled(inline="always")
def start_tile(tile, tiles_x, height, width, transmittance):
    """Set full transmittance for the pixels inside the image, and return the tile's corner."""
    x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    right, bottom = lanes(np.float32(width - x0)), lanes(np.float32(height - y0))
    for block in range(BLOCKS):
        inside = keep_lt(load(_X, block * LANES), right, lanes(_ONE))
        store(transmittance, block * LANES, keep_lt(load(_Y, block * LANES), bottom, inside))
    return x0, y0


@compiled(inline="always")
def unfinished(transmittance):
    """Return a bit for each block with an unfinished pixel."""
    bits = 0
    for block in range(BLOCKS):
        if any_ge(load(transmittance, block * LANES), lanes(_STOP)):
            bits |= 1 << block
    return bits


@compiled(inline="always")
def gather(first, count, x0, y0, gaussian, geometry, records):
    """Copy the Gaussians of entries first..first + count of the band to contiguous records."""
    for k in range(count):
        i = gaussian[first + k]
        prefetch(geometry, gaussian[min(first + k + AHEAD, len(gaussian) - 1)] * geometry.shape[1])
        at = k * RECORD
        records[at] = geometry[i, 0] - np.float32(x0)
        records[at + 1] = geometry[i, 1] - np.float32(y0)
        for column in range(2, 6):
            records[at + column] = geometry[i, column]


@compiled(inline="always")
def _exponent(records, at, px, py):
    """Return the offsets of a copied Gaussian from pixel centres, and log2 of its unclipped alpha there."""
    dx, dy = load_same(records, at) - px, load_same(records, at + 1) - py
    slope = load_same(records, at + 3) * dy
    peak = load_same(records, at + 5) - load_same(records, at + 4) * dy * dy
    return dx, dy, peak - dx * (load_same(records, at + 2) * dx + slope)


@compiled(inline="always")
def _shine(exponent, light):
    """Return a Gaussian's unclipped alpha, alpha, weight and remaining light at transmittance `light`."""
    uncut = exp2_negative(exponent)
    alpha = keep_ge(exponent, lanes(_CUT), smaller(uncut, lanes(_TOP)))
    weight = light * alpha
    left = light - weight
    return uncut, alpha, keep_gt(left, lanes(_STOP), weight), keep_gt(left, lanes(_STOP), left)


@compiled(inline="always")
def weigh(block, first, count, reach, records, shades, width, transmittance, entries, weights):
    """Compute the weights of a chunk's Gaussians that reach a block, front to back.

    Args:
        first, count: entries of the chunk in the band.
        shades: channel values; those of Gaussian k start at k * width.
        entries, weights: outputs: each Gaussian's position in the chunk, and its 16 weights.

    Returns:
        number of Gaussians processed before all pixels were finished, and the sums of the first 4 channels.
    """
    light = load(transmittance, block * LANES)
    px, py = load(_X, block * LANES), load(_Y, block * LANES)
    done = 0
    one, two, three, four = lanes(_ZERO), lanes(_ZERO), lanes(_ZERO), lanes(_ZERO)
    for word in range(0, count, 64):
        bits = column_bits(reach, first + word, block)
        if count - word < 64:
            bits &= (1 << (count - word)) - 1
        while bits != 0:
            k = word + first_bit(bits)
            bits &= bits - 1
            _, _, exponent = _exponent(records, k * RECORD, px, py)
            _, _, weight, light = _shine(exponent, light)
            entries[done] = k
            store(weights, done * LANES, weight)
            done += 1
            shade = k * width
            one = one + weight * load_same(shades, shade)
            two = two + weight * load_same(shades, shade + 1)
            three = three + weight * load_same(shades, shade + 2)
            four = four + weight * load_same(shades, shade + 3)
            if not any_ge(light, lanes(_STOP)):
                break
    store(transmittance, block * LANES, light)
    return done, one, two, three, four


@compiled(inline="always")
def _add_group(sums, at, one, two, three, four):
    """Add one vector to the sums of each of 4 channels."""
    store(sums, at, load(sums, at) + one)
    store(sums, at + LANES, load(sums, at + LANES) + two)
    store(sums, at + 2 * LANES, load(sums, at + 2 * LANES) + three)
    store(sums, at + 3 * LANES, load(sums, at + 3 * LANES) + four)


@compiled
def blend(begin, end, base, tiles_x, tile_start, tile_end, gaussian, reach, geometry, colours, image, alpha):
    """Blend tiles: write premultiplied channels to image (H, W, C) and coverage to alpha (H, W)."""
    height, width, channels = image.shape
    per_gaussian = (channels + GROUP) // GROUP * GROUP
    stride = LANES * per_gaussian
    transmittance = aligned(PIXELS)
    sums = aligned(BLOCKS * stride)
    records = aligned(CHUNK * RECORD)
    shades = np.zeros(CHUNK * per_gaussian, np.float32)
    shades[::per_gaussian] = 1.0
    entries, weights = np.empty(CHUNK, np.int64), aligned(CHUNK * LANES)
    flat_image, flat_alpha = image.reshape(-1), alpha.reshape(-1)
    for tile in range(begin, end):
        x0, y0 = start_tile(tile, tiles_x, height, width, transmittance)
        sums[:] = 0.0
        for chunk in range(tile_start[tile], tile_end[tile], CHUNK):
            alive = unfinished(transmittance)
            if alive == 0:
                break
            count = min(tile_end[tile] - chunk, CHUNK)
            first = chunk - base
            gather(first, count, x0, y0, gaussian, geometry, records)
            for k in range(count):
                i = gaussian[first + k]
                for channel in range(channels):
                    shades[k * per_gaussian + 1 + channel] = colours[i, channel]
            for block in range(BLOCKS):
                if not (alive >> block) & 1:
                    continue
                done, one, two, three, four = weigh(
                    block, first, count, reach, records, shades, per_gaussian, transmittance, entries, weights
                )
                _add_group(sums, block * stride, one, two, three, four)
                for group in range(GROUP, per_gaussian, GROUP):
                    one, two, three, four = lanes(_ZERO), lanes(_ZERO), lanes(_ZERO), lanes(_ZERO)
                    for n in range(done):
                        weight = load(weights, n * LANES)
                        shade = entries[n] * per_gaussian + group
                        one = one + weight * load_same(shades, shade)
                        two = two + weight * load_same(shades, shade + 1)
                        three = three + weight * load_same(shades, shade + 2)
                        four = four + weight * load_same(shades, shade + 3)
                    _add_group(sums, block * stride + group * LANES, one, two, three, four)
        for block in range(BLOCKS):
            left, upper = x0 + 4 * (block & 3), y0 + 4 * (block >> 2)
            columns = min(4, width - left)
            for y in range(min(4, height - upper)):
                pixel, at = (upper + y) * width + left, block * stride + 4 * y
                for x in range(columns):
                    flat_alpha[pixel + x] = sums[at + x]
                for channel in range(channels):
                    at += LANES
                    for x in range(columns):
                        flat_image[(pixel + x) * channels + channel] = sums[at + x]


@compiled(inline="always")
def _load_gradients(x0, y0, stride, size, flats, grads, to_come):
    """Load the gradients of a tile's pixels by block and channel, and compute R before the first Gaussian."""
    height, width, channels = size
    image, alpha, grad_image, grad_alpha = flats
    if x0 + TILE > width or y0 + TILE > height:
        grads[:] = 0.0
        to_come[:] = 0.0
    for block in range(BLOCKS):
        left, upper = x0 + 4 * (block & 3), y0 + 4 * (block >> 2)
        columns = min(4, width - left)
        for y in range(min(4, height - upper)):
            pixel, at, spot = (upper + y) * width + left, block * stride + 4 * y, block * LANES + 4 * y
            for x in range(columns):
                grads[at + x] = grad_alpha[pixel + x]
                to_come[spot + x] = alpha[pixel + x] * grad_alpha[pixel + x]
            for channel in range(channels):
                at += LANES
                for x in range(columns):
                    there = (pixel + x) * channels + channel
                    grads[at + x] = grad_image[there]
                    to_come[spot + x] += image[there] * grad_image[there]


@compiled
def blend_backward(
    begin,
    end,
    base,
    tiles_x,
    tile_start,
    tile_end,
    gaussian,
    reach,
    geometry,
    colours,
    pixels,
    slots,
    columns,
):
    """Compute the gradient of `blend`, in one slot of `columns` numbers per list entry.

    A slot contains the moments of v = alpha dL/dalpha (see MOMENTS), then dL/dcolour per channel. Slots of
    Gaussians behind finished pixels are zero. `pixels` contains image and alpha, and the gradients of both.
    """
    image, alpha, grad_image, grad_alpha = pixels
    height, width, channels = image.shape
    transmittance = aligned(PIXELS)
    to_come = aligned(PIXELS)
    stride = LANES * (channels + 1)
    grads = aligned(BLOCKS * stride)
    colour_sums = aligned(LANES * channels)
    records = aligned(CHUNK * RECORD)
    flats = image.reshape(-1), alpha.reshape(-1), grad_image.reshape(-1), grad_alpha.reshape(-1)
    zero = lanes(_ZERO)
    for tile in range(begin, end):
        x0, y0 = start_tile(tile, tiles_x, height, width, transmittance)
        _load_gradients(x0, y0, stride, image.shape, flats, grads, to_come)
        alive = unfinished(transmittance)
        for chunk in range(tile_start[tile], tile_end[tile], CHUNK):
            count = min(tile_end[tile] - chunk, CHUNK)
            if alive == 0:
                slots[(chunk - base) * columns : (chunk - base + count) * columns] = 0.0
                continue
            gather(chunk - base, count, x0, y0, gaussian, geometry, records)
            for k in range(count):
                slot = chunk - base + k
                bits = np.int64(reach[slot]) & alive
                if bits == 0:
                    for column in range(columns):
                        slots[slot * columns + column] = 0.0
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
                    if not any_ge(left, lanes(_STOP)):
                        alive ^= 1 << block
                    at = block * stride
                    shade = load(grads, at)
                    if channels == 3:  # keeping the colour sums in registers is 20 % faster
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
                    behind = load(to_come, spot) - seen
                    store(to_come, spot, behind)
                    v = seen - behind * here * reciprocal(lanes(_ONE) - here)
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
                    store_sums(slots, at, (s, sx, sy, sxx, sxy, syy, red, green, blue))
                else:
                    store_sums(slots, at, (s, sx, sy, sxx, sxy, syy))
                    for channel in range(channels):
                        slots[at + MOMENTS + channel] = lane_sum(load(colour_sums, LANES * channel))


@compiled
def add_slots(begin, end, tiles, base, tile_start, tile_end, gaussian, slots, columns, sums):
    """Add the slots of Gaussians begin..end to their sums, in the order of the entries.

    Rows of `sums` are padded to whole vectors; numbers beyond `columns` have no meaning.
    """
    flat_sums, width = sums.reshape(-1), sums.shape[1]
    for tile in range(tiles[0], tiles[1]):
        for entry in range(tile_start[tile] - base, tile_end[tile] - base):
            prefetch(flat_sums, gaussian[min(entry + AHEAD, len(gaussian) - 1)] * width)
            i = gaussian[entry]
            if begin <= i < end:
                for k in range(0, width, LANES):
                    added = load(flat_sums, i * width + k) + load(slots, entry * columns + k)
                    store(flat_sums, i * width + k, added)


@compiled
def sparse_rows(
    begin,
    end,
    base,
    tiles_x,
    tile_start,
    tile_end,
    gaussian,
    reach,
    size_hw,
    step,
    geometry,
    least,
    counts,
    out,
):
    """Count the weights >= `least` of each pixel (row-major) of tiles begin..end; with `out`, write them.

    Pixels outside every `step`-th row and column get none.

    `out` is None in the first pass. In the second pass, it contains the length of the longest row, the row
    starts of the sparse matrix, and arrays for its columns (ascending) and weights.
    """
    height, width = size_hw
    transmittance, size_of, wanted = aligned(PIXELS), np.empty(PIXELS, np.int64), np.empty(PIXELS, np.bool_)
    records, by_lane = aligned(CHUNK * RECORD), aligned(CHUNK * LANES)
    entries, rows = np.empty(CHUNK, np.int64), np.empty(CHUNK, np.int32)
    if out is not None:
        longest, row_start, columns, weights = out
        room = (longest // LANES + 1) * LANES  # a pixel's row and at least one more entry
        held, held_weights = np.empty(PIXELS * room, np.float32), np.empty(PIXELS * room, np.float32)
        held_columns, rank = held.view(np.int32), np.empty(room, np.float32)
    for tile in range(begin, end):
        x0, y0 = start_tile(tile, tiles_x, height, width, transmittance)
        for pixel in range(PIXELS):
            x, y = x0 + np.int64(_X[pixel]), y0 + np.int64(_Y[pixel])
            wanted[pixel] = x % step == 0 and y % step == 0
            if not wanted[pixel]:
                transmittance[pixel] = _ZERO
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
                if out is None:
                    for n in range(done):
                        for lane in range(LANES):
                            weight = by_lane[n * LANES + lane]
                            size_of[block * LANES + lane] += (weight > _ZERO) & (weight >= least)
                    continue
                for n in range(done):
                    rows[n] = gaussian[chunk - base + entries[n]]
                for lane in range(LANES if done else 0):
                    pixel = block * LANES + lane
                    if not wanted[pixel]:
                        continue
                    at = pixel * room + size_of[pixel]
                    for n in range(done):  # branch-free, because a branch would be unpredictable
                        weight = by_lane[n * LANES + lane]
                        held_columns[at], held_weights[at] = rows[n], weight
                        at += np.int64((weight > _ZERO) & (weight >= least))
                    size_of[pixel] = at - pixel * room
        for pixel in range(PIXELS):
            x, y = x0 + np.int64(_X[pixel]), y0 + np.int64(_Y[pixel])
            if x >= width or y >= height:
                continue
            if out is None:
                counts[y * width + x] = size_of[pixel]
                continue
            first, size = pixel * room, size_of[pixel]
            _rank(held, first, size, rank)
            start = row_start[y * width + x]
            for k in range(size):
                at = start + np.int64(rank[k])
                columns[at], weights[at] = held_columns[first + k], held_weights[first + k]


@compiled(inline="always")
def _rank(held, first, size, rank):
    """Count the smaller columns for each entry of a row; bits read as floats keep the order of columns."""
    for begin in range(0, size, LANES):
        depths, smaller = load(held, first + begin), lanes(_ZERO)
        for k in range(first, first + size):
            smaller = smaller + keep_gt(depths, lanes(held[k]), lanes(_ONE))
        store(rank, begin, smaller)
