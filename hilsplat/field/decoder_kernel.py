"""Chain of dense layers with ReLUs as one compiled loop, whose values stay in the L1 cache.

Rows are SIMD lanes, and as many outputs are summed together as fit in the registers. The order of the sums
of a row does not depend on the other rows.
"""

from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float32, Int64

from hilsplat.base.compiled import compiled
from hilsplat.base.lane_products import MOST_ROWS, WIDE_COLUMNS, rows_of_products

ROWS = 2 * WIDE_COLUMNS
"""Rows that pass through the layers together, so that weights are read from the L2 cache once for all."""

UNITS = MOST_ROWS
"""Outputs of a layer that are summed together; layers are padded to a multiple."""

_add_products = rows_of_products(UNITS)


class PackedLayers(NamedTuple):
    """Layers in the layout of the compiled loop.

    Attributes:
        widths: number of inputs, then of each layer's outputs.
        weights: weights by layer and output.
        biases: biases by layer.
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
            weights.append(np.pad(weight, ((0, missing), (0, 0))).reshape(-1))
            biases.append(np.pad(bias, (0, missing)))
        found = (np.concatenate(each).astype(np.float32) for each in (weights, biases))
        return PackedLayers(np.array(widths), *found)

    def through(self, rows: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """Return the outputs of the last layer, scaled to unit length."""
        out = np.empty((len(rows), self.widths[-1]), np.float32)
        _through(np.ascontiguousarray(rows, np.float32), *self, out)
        return out


@compiled
@no_type_check
def _through(rows, widths, weights, biases, out):
    widest = (widths.max() + UNITS - 1) // UNITS * UNITS
    values, following = np.zeros(widest * ROWS, np.float32), np.zeros(widest * ROWS, np.float32)
    lengths = np.empty(ROWS, np.float32)
    for begin in range(0, len(rows), ROWS):
        count = min(ROWS, len(rows) - begin)
        for channel in range(widths[0]):
            for row in range(count):
                values[channel * ROWS + row] = rows[begin + row, channel]
        weight, bias = 0, 0
        for layer in range(len(widths) - 1):
            inputs, outputs = widths[layer], (widths[layer + 1] + UNITS - 1) // UNITS * UNITS
            for unit in range(outputs):
                following[unit * ROWS : (unit + 1) * ROWS] = biases[bias + unit]
            for unit in range(0, outputs, UNITS):
                for lane in range(0, ROWS, WIDE_COLUMNS):
                    to = unit * ROWS + lane
                    _add_products(
                        following, to, ROWS, weights, weight, inputs, values, lane, ROWS, inputs, False, True
                    )
                weight += UNITS * inputs
            if layer < len(widths) - 2:
                for place in range(outputs * ROWS):
                    following[place] = max(following[place], np.float32(0))
            bias += outputs
            values, following = following, values
        lengths[:] = 0
        for channel in range(widths[-1]):
            for row in range(ROWS):
                lengths[row] += values[channel * ROWS + row] ** 2
        for row in range(ROWS):
            lengths[row] = max(np.sqrt(lengths[row]), np.float32(1e-12))
        for channel in range(widths[-1]):
            for row in range(ROWS):
                values[channel * ROWS + row] /= lengths[row]
        for row in range(count):
            for channel in range(widths[-1]):
                out[begin + row, channel] = values[channel * ROWS + row]
