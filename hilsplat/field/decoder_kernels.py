"""Compiled loops that decode latents (see `decoder`)."""

import numpy as np

from cpusplat.compiled import compiled
from cpusplat.lane_products import MAX_ROWS, WIDE_COLUMNS, rows_of_products
from cpusplat.lanes import (
    WIDTH,
    bits_ge,
    keep_gt,
    lane_sum,
    lanes,
    load,
    load_same,
    smaller,
    store,
    transpose,
)

ROWS = 4 * WIDTH  # rows processed together; for each such block, weights are read from L2 once
UNITS = MAX_ROWS  # outputs of a layer that are summed together; layers are padded to a multiple of this
LATENT = 3  # longest latents that are decoded by pieces; longer ones have many more pieces
TERMS = LATENT + 1  # terms of an affine function: its value at the anchor, and its derivatives
PIECES = ROWS // TERMS  # pieces that are computed together
WORTHWHILE = 2 * ROWS  # rows that the network decodes in the time that `PIECES` pieces take

_add_products = rows_of_products(UNITS)


@compiled
def through_layers(rows, widths, weights, biases, out):
    widest, wide = _padded(widths.max() + UNITS, WIDTH), _padded(widths[-1], WIDTH)
    values, following = np.zeros(widest * ROWS, np.float32), np.zeros(widest * ROWS, np.float32)
    no_planes, block = np.empty(0, np.float32), np.empty(WIDTH * wide, np.float32)
    layers, left = (widths, weights, biases), np.arange(len(rows))
    if widths[0] <= LATENT and len(widths) > 2:
        left = _decode_pieces(rows, layers, values, following, out)
    for begin in range(0, len(left), ROWS):
        some = left[begin : begin + ROWS]
        for channel in range(widths[0]):
            for lane, row in enumerate(some):
                values[channel * ROWS + lane] = rows[row, channel]
        decoded = _outputs(layers, values, following, no_planes)
        for first in range(0, len(some), WIDTH):
            for channel in range(0, wide, WIDTH):
                transpose(decoded, channel * ROWS + first, ROWS, block, channel, wide)
            for lane, row in enumerate(some[first : first + WIDTH]):
                _write_unit(block[lane * wide : (lane + 1) * wide], out[row])


@compiled
def _outputs(layers, values, following, planes):
    """Return the last layer's outputs for the inputs in `values`; the input arrays are overwritten.

    All arrays have `ROWS` lanes per channel or unit, one for each row. If `planes` isn't empty, lanes are the
    values at `PIECES` anchors, followed by the derivatives in each direction. Those of all hidden units are
    then written to `planes`, with such a sign that the affine functions are positive inside of the piece.
    """
    widths, weights, biases = layers
    weight, bias, plane = 0, 0, 0
    for layer in range(len(widths) - 1):
        inputs, outputs = widths[layer], _padded(widths[layer + 1], UNITS)
        for unit in range(outputs):
            following[unit * ROWS : (unit + 1) * ROWS] = biases[bias + unit]
            if len(planes):  # derivatives have no bias
                following[unit * ROWS + PIECES : (unit + 1) * ROWS] = 0
        for unit in range(0, outputs, UNITS):
            for lane in range(0, ROWS, WIDE_COLUMNS):
                to = unit * ROWS + lane
                _add_products(
                    following, to, ROWS, weights, weight, inputs, values, lane, ROWS, inputs, False, True
                )
            weight += UNITS * inputs
        if layer < len(widths) - 2 and len(planes):
            for unit in range(0, outputs * ROWS, ROWS):
                at_anchor = load(following, unit)
                for at in range(unit, unit + ROWS, PIECES):
                    term = load(following, at)
                    if_on = keep_gt(at_anchor, lanes(np.float32(0)), term)
                    store(planes, plane + at, if_on + if_on - term)
                    store(following, at, if_on)
            plane += outputs * ROWS
        elif layer < len(widths) - 2:
            for position in range(outputs * ROWS):
                following[position] = max(following[position], np.float32(0))
        bias += outputs
        values, following = following, values
    return values


@compiled
def _decode_pieces(rows, layers, values, following, out):
    """Decode the rows of common pieces, and return the indices of the other rows.

    Anchors are evenly spaced among the rows not yet decoded, so they are likely to be in large pieces. The
    search ends when the last pieces contain fewer than `WORTHWHILE` rows.
    """
    widths, step, left = layers[0], len(rows) + WIDTH, np.arange(len(rows))
    planes = np.empty((len(layers[2]) - _padded(widths[-1], UNITS)) * ROWS, np.float32)
    points, caught = np.zeros(LATENT * step, np.float32), WORTHWHILE
    while caught >= WORTHWHILE and len(left) > WORTHWHILE:
        for channel in range(widths[0]):
            for number, row in enumerate(left):
                points[channel * step + number] = rows[row, channel]
        anchors = (2 * np.arange(PIECES) + 1) * len(left) // (2 * PIECES)
        values[: widths[0] * ROWS] = 0
        for piece, anchor in enumerate(anchors):
            for channel in range(widths[0]):
                values[channel * ROWS + piece] = points[channel * step + anchor]
                values[channel * ROWS + (channel + 1) * PIECES + piece] = 1
        outputs = _outputs(layers, values, following, planes)
        taken = np.zeros(len(left), np.bool_)
        for piece, anchor in enumerate(anchors):
            if not taken[anchor]:
                _decode_piece(_terms(planes, piece), _terms(outputs, piece), points, anchor, taken, left, out)
        caught = taken.sum()
        left = left[~taken]
    return left


@compiled
def _terms(values, piece):
    units = len(values) // ROWS
    terms = np.empty(TERMS * units, np.float32)
    for term in range(TERMS):
        for unit in range(units):
            terms[term * units + unit] = values[unit * ROWS + term * PIECES + piece]
    return terms


@compiled(forceinline=True)
def _height(terms, units, unit, x, y, z):
    """Return a hidden unit's affine function at 16 points."""
    one, other = load_same(terms, units + unit) * x, load_same(terms, 2 * units + unit) * y
    return load_same(terms, unit) + one + (other + load_same(terms, 3 * units + unit) * z)


@compiled
def _decode_piece(planes, outputs, points, anchor, taken, left, out):
    """Decode the points in a piece that are not yet taken, and mark them as taken."""
    step, units, wide = len(points) // LATENT, len(planes) // TERMS, len(outputs) // TERMS
    x0, y0, z0 = points[anchor], points[step + anchor], points[2 * step + anchor]
    row = np.empty(wide, np.float32)
    for begin in range(0, len(taken), WIDTH):
        x, y = load(points, begin) - x0, load(points, step + begin) - y0
        z = load(points, 2 * step + begin) - z0
        lowest = lower = lanes(np.float32(1))
        inside, at = 1, units - UNITS
        # The last units are tested first, because most other points are outside of one of them.
        while inside and at >= 0:
            for unit in range(at, at + UNITS, 2):  # two minima, so that neither has to wait
                lowest = smaller(lowest, _height(planes, units, unit, x, y, z))
                lower = smaller(lower, _height(planes, units, unit + 1, x, y, z))
            inside = bits_ge(smaller(lowest, lower), lanes(np.float32(0)))
            at -= UNITS
        for point in range(begin, min(begin + WIDTH, len(taken)) if inside else begin):
            if (inside >> (point - begin)) & 1 and not taken[point]:
                taken[point] = True
                x, y = lanes(points[point] - x0), lanes(points[step + point] - y0)
                z = lanes(points[2 * step + point] - z0)
                for at in range(0, wide, WIDTH):
                    value = load(outputs, at) + load(outputs, wide + at) * x
                    yz_terms = load(outputs, 2 * wide + at) * y + load(outputs, 3 * wide + at) * z
                    store(row, at, value + yz_terms)
                _write_unit(row, out[left[point]])


@compiled
def _write_unit(row, out):
    """Scale a padded row to unit length."""
    row[len(out) :] = 0
    total = lanes(np.float32(0))
    for at in range(0, len(row), WIDTH):
        value = load(row, at)
        total = total + value * value
    scale = np.float32(1) / max(np.sqrt(lane_sum(total)), np.float32(1e-12))
    for channel in range(len(out)):
        out[channel] = row[channel] * scale


@compiled
def _padded(count, multiple):
    return (count + multiple - 1) // multiple * multiple
