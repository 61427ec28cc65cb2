"""Decoding of latents by a network of dense layers and ReLUs, in compiled loops.

Such a network is affine where no ReLU changes sign. Pixels of an object have similar latents, so most pixels
of a view share a few hundred of these affine pieces. A piece is given by the network's value and derivatives
at one latent, its anchor. It contains all latents for which every hidden unit has the sign that it has at the
anchor, and decodes them exactly in a tenth of the network's time.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from hilsplat.field.decoder_kernels import UNITS, through_layers


class PackedLayers(NamedTuple):
    """Dense layers with ReLUs between them, in the memory layout that the compiled loops need.

    The values of `ROWS` rows fit in the L2 cache. Rows are SIMD lanes, and as many outputs are summed
    together as fit in the registers.
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
        flat_weights, flat_biases = (np.concatenate(parts).astype(np.float32) for parts in (weights, biases))
        return PackedLayers(np.array(widths), flat_weights, flat_biases)

    def through(self, rows: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """Return the last layer's outputs, scaled to unit length; other rows affect only the rounding."""
        out = np.empty((len(rows), self.widths[-1]), np.float32)
        through_layers(np.ascontiguousarray(rows, np.float32), *self, out)
        return out
