"""A chain of dense layers with ReLU between them as one compiled loop; values stay in the fastest cache.

Rows are the lanes of vectors: a weight is read once for 64 rows, and the sums of a row run in the same order
whatever rows it is decoded with. Four weights meet four vectors in sixteen registers.
"""

from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float32, Int64

from hilsplat.base.compiled import compiled
from hilsplat.base.lanes import WIDTH, lanes, larger, load, store

ROWS = 4 * WIDTH
"""Rows that pass the layers together."""
UNITS = 4
"""Outputs of a layer that are summed together; layers get a multiple of them."""


class PackedLayers(NamedTuple):
    """Layers as the loop reads them.

    Attributes:
        widths: numbers of inputs, of each layer's outputs.
        weights: layer by layer; of each, 4 outputs by 4, input by input.
        biases: layer by layer.
    """

    widths: Int64[np.ndarray, " L_plus_1"]
    weights: Float32[np.ndarray, " W"]
    biases: Float32[np.ndarray, " V"]

    @staticmethod
    def of(layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> "PackedLayers":
        """Pack weights (outputs, inputs) and biases (outputs) of each layer."""
        widths = [layers[0][0].shape[1], *(len(bias) for _, bias in layers)]
        weights, biases = [], []
        for weight, bias in layers:
            missing = -len(bias) % UNITS
            padded = np.pad(weight, ((0, missing), (0, 0))).reshape(-1, UNITS, weight.shape[1])
            weights.append(padded.transpose(0, 2, 1).reshape(-1))
            biases.append(np.pad(bias, (0, missing)))
        found = (np.concatenate(each).astype(np.float32) for each in (weights, biases))
        return PackedLayers(np.array(widths), *found)

    def through(self, rows: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """Outputs of the last layer, divided by their lengths."""
        out = np.empty((len(rows), self.widths[-1]), np.float32)
        _through(np.ascontiguousarray(rows, np.float32), *self, out)
        return out


@compiled
@no_type_check
def _through(rows, widths, weights, biases, out):
    widest = (widths.max() + UNITS - 1) // UNITS * UNITS
    values, following = np.zeros(widest * ROWS, np.float32), np.zeros(widest * ROWS, np.float32)
    for begin in range(0, len(rows), ROWS):
        count = min(ROWS, len(rows) - begin)
        for channel in range(widths[0]):
            for row in range(count):
                values[channel * ROWS + row] = rows[begin + row, channel]
        weight, bias = 0, 0
        for layer in range(len(widths) - 1):
            floor = np.float32(-np.inf) if layer == len(widths) - 2 else np.float32(0)
            for unit in range(0, widths[layer + 1], UNITS):
                at = unit * ROWS
                _four_units(weights, weight, biases, bias + unit, values, widths[layer], floor, following, at)
                weight += UNITS * widths[layer]
            bias += (widths[layer + 1] + UNITS - 1) // UNITS * UNITS
            values, following = following, values
        for row in range(count):
            square = np.float32(0)
            for channel in range(widths[-1]):
                square += values[channel * ROWS + row] ** 2
            length = max(np.sqrt(square), np.float32(1e-12))
            for channel in range(widths[-1]):
                out[begin + row, channel] = values[channel * ROWS + row] / length


@compiled(inline="always")
@no_type_check
def _four_units(weights, weight, biases, bias, values, inputs, floor, out, at):
    """Four outputs of a layer, at least `floor`, for all rows."""
    a0, b0, c0, d0 = _four(biases[bias])
    a1, b1, c1, d1 = _four(biases[bias + 1])
    a2, b2, c2, d2 = _four(biases[bias + 2])
    a3, b3, c3, d3 = _four(biases[bias + 3])
    for k in range(inputs):
        a, b = load(values, k * ROWS), load(values, k * ROWS + WIDTH)
        c, d = load(values, k * ROWS + 2 * WIDTH), load(values, k * ROWS + 3 * WIDTH)
        first = weight + UNITS * k
        w = lanes(weights[first])
        a0, b0, c0, d0 = a0 + w * a, b0 + w * b, c0 + w * c, d0 + w * d
        w = lanes(weights[first + 1])
        a1, b1, c1, d1 = a1 + w * a, b1 + w * b, c1 + w * c, d1 + w * d
        w = lanes(weights[first + 2])
        a2, b2, c2, d2 = a2 + w * a, b2 + w * b, c2 + w * c, d2 + w * d
        w = lanes(weights[first + 3])
        a3, b3, c3, d3 = a3 + w * a, b3 + w * b, c3 + w * c, d3 + w * d
    _write(out, at, floor, a0, b0, c0, d0)
    _write(out, at + ROWS, floor, a1, b1, c1, d1)
    _write(out, at + 2 * ROWS, floor, a2, b2, c2, d2)
    _write(out, at + 3 * ROWS, floor, a3, b3, c3, d3)


@compiled(inline="always")
@no_type_check
def _four(value):
    return lanes(value), lanes(value), lanes(value), lanes(value)


@compiled(inline="always")
@no_type_check
def _write(out, at, floor, a, b, c, d):
    store(out, at, larger(a, lanes(floor)))
    store(out, at + WIDTH, larger(b, lanes(floor)))
    store(out, at + 2 * WIDTH, larger(c, lanes(floor)))
    store(out, at + 3 * WIDTH, larger(d, lanes(floor)))
