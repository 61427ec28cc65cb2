"""Decoding of latents by a network of dense layers and ReLUs, in compiled loops.

Such a network is affine between the kinks of its ReLUs. Pixels of an object have similar latents, so nine
tenths of a view's pixels lie in a few hundred of these affine pieces. A piece is given by the network's value
and derivatives at one latent, its anchor. It contains all latents for which every hidden unit has the sign
that it has at the anchor, and decodes them exactly in a tenth of the network's time.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from hilsplat.base.compiled import compiled
from hilsplat.base.lane_products import MOST_ROWS, WIDE_COLUMNS, rows_of_products
from hilsplat.base.lanes import (
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
UNITS = MOST_ROWS  # outputs of a layer that are summed together; layers are padded to a multiple of this

MOST_LATENT = 3
"""Longest latents that are decoded by pieces; longer ones have many more pieces."""

TERMS = MOST_LATENT + 1
"""Terms of an affine function of a latent: its value and its derivatives at the anchor."""

PIECES = WIDTH
"""Number of pieces that are computed together: their terms take `ROWS` lanes."""

WORTHWHILE = 2 * ROWS
"""Fewest rows that `PIECES` pieces must contain: the network decodes about this many in the same time."""

_add_products = rows_of_products(UNITS)


class PackedLayers(NamedTuple):
    """Dense layers with ReLUs between them, in the memory layout that the compiled loops need.

    The values fit in the L1 cache. Rows are SIMD lanes, and as many outputs are summed together as fit in
    the registers.
    """

    widths: Int64[np.ndarray, " L_plus_1"]  # number of inputs, then number of each layer's outputs
    weights: Float32[np.ndarray, " W"]
    biases: Float32[np.ndarray, " V"]

    @staticmethod
    def of(layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> "PackedLayers":
        """Pack weights (outputs, inputs) and biases (outputs) of each layer."""
        widths = [layers[0][0].shape[1], *(len(bias) for _, bias in layers)]
        weights, biases = [], []
        for weight, bias in layers:
            missing = -len(bias) % UNITS
            weights.append(np.pad(weight, ((0, missing), (0, 0))).reshape(-1))
            biases.append(np.pad(bias, (0, missing)))
        flat_weights, flat_biases = (np.concatenate(each).astype(np.float32) for each in (weights, biases))
        return PackedLayers(np.array(widths), flat_weights, flat_biases)

    def through(self, rows: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """Return the outputs of the last layer, scaled to unit length.

        The result of a row depends on the other rows only by rounding (about 1e-7).
        """
        out = np.empty((len(rows), self.widths[-1]), np.float32)
        _through(np.ascontiguousarray(rows, np.float32), *self, out)
        return out


@compiled
def _through(rows, widths, weights, biases, out):
    widest = _padded(widths.max())
    values, following = np.zeros(widest * ROWS, np.float32), np.zeros(widest * ROWS, np.float32)
    layers = (widths, weights, biases)
    left = np.arange(len(rows))
    if widths[0] <= MOST_LATENT and len(widths) > 2 and len(rows) > WORTHWHILE:
        left = _decode_pieces(rows, layers, values, following, out)
    no_planes = np.empty(0, np.float32)
    for begin in range(0, len(left), ROWS):
        some = left[begin : begin + ROWS]
        for place, row in enumerate(some):
            for channel in range(widths[0]):
                values[channel * ROWS + place] = rows[row, channel]
        _write_rows(_outputs(layers, values, following, no_planes), some, out)


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
        inputs, outputs = widths[layer], (widths[layer + 1] + UNITS - 1) // UNITS * UNITS
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
            for place in range(outputs * ROWS):
                following[place] = max(following[place], np.float32(0))
        bias += outputs
        values, following = following, values
    return values


@compiled
def _decode_pieces(rows, layers, values, following, out):
    """Decode the rows of common pieces, and return the indices of the other rows.

    Anchors are rows that are evenly spaced among those not yet decoded, so they are likely to be in large
    pieces. The search ends when the last pieces contain fewer than `WORTHWHILE` rows.
    """
    widths = layers[0]
    latent, hidden = widths[0], len(layers[2]) - (widths[-1] + UNITS - 1) // UNITS * UNITS
    planes = np.empty(hidden * ROWS, np.float32)
    left = np.arange(len(rows))
    step = len(rows) + WIDTH
    points = np.zeros(MOST_LATENT * step, np.float32)
    members = np.empty(len(rows), np.int64)
    caught = WORTHWHILE
    while caught >= WORTHWHILE and len(left) > WORTHWHILE:
        for place, row in enumerate(left):
            for channel in range(latent):
                points[channel * step + place] = rows[row, channel]
        anchors = (2 * np.arange(PIECES) + 1) * len(left) // (2 * PIECES)
        values[: latent * ROWS] = 0
        for piece in range(PIECES):
            for channel in range(latent):
                values[channel * ROWS + piece] = rows[left[anchors[piece]], channel]
                values[channel * ROWS + (channel + 1) * PIECES + piece] = 1
        outputs = _outputs(layers, values, following, planes)
        taken = np.zeros(len(left), np.bool_)
        caught = 0
        for piece in range(PIECES):
            if not taken[anchors[piece]]:
                found = _members(planes, piece, points, anchors[piece], taken, members)
                _write_affine(outputs, piece, points, anchors[piece], members[:found], left, out)
                caught += found
        left = left[~taken]
    return left


@compiled(forceinline=True)
def _value(own, unit, x, y, z):
    """Return a unit's affine function at 16 points."""
    one, other = load_same(own, unit + 1) * x, load_same(own, unit + 3) * z
    return load_same(own, unit) + one + (load_same(own, unit + 2) * y + other)


@compiled
def _members(planes, piece, points, anchor, taken, members):
    """Mark the points in a piece as taken, write their indices to `members`, and return their number."""
    own, step = _of_piece(planes, piece), len(points) // MOST_LATENT
    last = len(own) - UNITS * TERMS
    x0, y0, z0 = points[anchor], points[step + anchor], points[2 * step + anchor]
    found = 0
    for begin in range(0, len(taken), WIDTH):
        x, y = load(points, begin) - x0, load(points, step + begin) - y0
        z = load(points, 2 * step + begin) - z0
        lowest = lower = lanes(np.float32(1))
        inside, at = 1, last
        # The last units are tested first, because most other points are outside of one of them.
        while inside and at >= 0:
            for unit in range(at, at + UNITS * TERMS, 2 * TERMS):  # two minima, so that neither has to wait
                lowest = smaller(lowest, _value(own, unit, x, y, z))
                lower = smaller(lower, _value(own, unit + TERMS, x, y, z))
            inside = bits_ge(smaller(lowest, lower), lanes(np.float32(0)))
            at -= UNITS * TERMS
        if inside:
            for lane in range(min(WIDTH, len(taken) - begin)):
                if (inside >> lane) & 1 and not taken[begin + lane]:
                    taken[begin + lane] = True
                    members[found] = begin + lane
                    found += 1
    return found


@compiled
def _of_piece(values, piece):
    """Return the terms of one piece, unit by unit."""
    own = np.empty(len(values) // ROWS * TERMS, np.float32)
    for unit in range(len(values) // ROWS):
        for term in range(TERMS):
            own[unit * TERMS + term] = values[unit * ROWS + term * PIECES + piece]
    return own


@compiled
def _write_affine(outputs, piece, points, anchor, members, left, out):
    """Decode the members of a piece."""
    channels, step = out.shape[1], len(points) // MOST_LATENT
    wide = _padded(channels)
    terms, row = np.zeros(TERMS * wide, np.float32), np.empty(wide, np.float32)
    for term in range(TERMS):
        for channel in range(channels):
            terms[term * wide + channel] = outputs[channel * ROWS + term * PIECES + piece]
    for point in members:
        x = lanes(points[point] - points[anchor])
        y = lanes(points[step + point] - points[step + anchor])
        z = lanes(points[2 * step + point] - points[2 * step + anchor])
        for at in range(0, wide, WIDTH):
            value = load(terms, at) + load(terms, wide + at) * x
            value = value + load(terms, 2 * wide + at) * y + load(terms, 3 * wide + at) * z
            store(row, at, value)
        _write_unit(row, out[left[point]])


@compiled
def _write_rows(values, rows, out):
    """Scale outputs in lanes to unit length, and write each lane to its row of `out`."""
    wide = _padded(out.shape[1])
    block = np.empty(WIDTH * wide, np.float32)
    for begin in range(0, len(rows), WIDTH):
        for channel in range(0, wide, WIDTH):
            transpose(values, channel * ROWS + begin, ROWS, block, channel, wide)
        for lane, row in enumerate(rows[begin : begin + WIDTH]):
            _write_unit(block[lane * wide : (lane + 1) * wide], out[row])


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
def _padded(channels):
    return (channels + WIDTH - 1) // WIDTH * WIDTH
