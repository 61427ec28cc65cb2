"""Scene autoencoder of LangSplat: a trained network from CLIP vectors to a few numbers and back."""

from collections.abc import Mapping
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from hilsplat.base.arrays import write_tensors
from hilsplat.field.decoder_kernel import PackedLayers

ENCODER_WIDTHS = (256, 128, 64, 32)
DECODER_WIDTHS = (16, 32, 64, 128, 256, 256)
NORM_EPS = 1e-5
"""Epsilon added to the variances of BatchNorm, as in torch."""


class Layer(NamedTuple):
    """A linear layer, with the normalisation and activation before it.

    Attributes:
        name: name of its weights in the file.
        norm: name of the BatchNorm before it; empty if there is none.
        relu: whether a ReLU is applied to its inputs, after the BatchNorm.
        inputs: number of inputs.
        outputs: number of outputs.
    """

    name: str
    norm: str
    relu: bool
    inputs: int
    outputs: int


def layers_of(channels: int, latent: int) -> tuple[list[Layer], list[Layer]]:
    """Return the layers of encoder and decoder; no layer is wider than the vectors."""
    sides = []
    for side, widths, norm in (("encoder", ENCODER_WIDTHS, True), ("decoder", DECODER_WIDTHS, False)):
        between = [min(width, channels) for width in widths]
        ends = [channels, *between, latent] if norm else [latent, *between, channels]
        every = 3 if norm else 2  # numbering of torch's nn.Sequential, which counts norms and ReLUs
        sides.append(
            [
                Layer(f"{side}.{every * k}", f"{side}.{every * k - 2}" if norm and k else "", k > 0, *sizes)
                for k, sizes in enumerate(pairwise(ends))
            ]
        )
    return sides[0], sides[1]


def torch_generator(seed: int) -> np.random.RandomState:
    """Return the generator that `torch.manual_seed(seed)` initialises, a Mersenne Twister."""
    return np.random.RandomState(seed % 2**32)


def unit(vectors: Float32[np.ndarray, "B C"]) -> Float32[np.ndarray, "B C"]:
    """Scale rows to unit length."""
    return vectors / np.maximum(np.sqrt(np.square(vectors).sum(axis=1, keepdims=True)), np.float32(1e-12))


class Autoencoder:
    """LangSplat's scene autoencoder, C -> 256 -> 128 -> 64 -> 32 -> d and back, unit length at both ends.

    Departs: layer widths never exceed C. The encoder's BatchNorm (measured better than LayerNorm or none)
    is trained on full batches only, and then uses the statistics of all vectors: see
    `network_training.train_autoencoder`. Arrays are named and laid out as in torch's modules.

    Args:
        channels: width C of the CLIP vectors.
        latent: size d of a latent.
        arrays: arrays of the layers, float32.
    """

    def __init__(self, channels: int, latent: int, arrays: Mapping[str, np.ndarray]) -> None:
        self.channels, self.latent = channels, latent
        self.arrays = dict(arrays)
        self._encoder, self._decoder = layers_of(channels, latent)

    def encode_array(self, vectors: Float32[np.ndarray, "B C"]) -> Float32[np.ndarray, "B D"]:
        """Encode vectors as latents of unit length."""
        values = vectors
        for layer in self._encoder:
            weight, bias = self._affine(layer.name)
            if layer.norm:
                scale, shift = self._affine(layer.norm)
                mean, var = (self.arrays[f"{layer.norm}.running_{name}"] for name in ("mean", "var"))
                factor = scale / np.sqrt(var + np.float32(NORM_EPS))
                values = np.maximum(values * factor + (shift - mean * factor), 0)
            values = values @ weight.T + bias
        return unit(values)

    def decode_array(self, latents: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """Decode latents of any length to vectors of unit length."""
        return self._packed_decoder.through(latents)

    def _affine(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        return self.arrays[f"{name}.weight"], self.arrays[f"{name}.bias"]

    @cached_property
    def _packed_decoder(self) -> PackedLayers:
        return PackedLayers.of([self._affine(layer.name) for layer in self._decoder])

    @staticmethod
    def drawn(channels: int, latent: int, twister: np.random.RandomState) -> "Autoencoder":
        """Draw the weights that torch draws from this generator state; BatchNorm is the identity."""
        arrays: dict[str, np.ndarray] = {}
        for layer in (layer for side in layers_of(channels, latent) for layer in side):
            if layer.norm:
                values = {"weight": 1, "bias": 0, "running_mean": 0, "running_var": 1}
                arrays |= {
                    f"{layer.norm}.{name}": np.full(layer.inputs, value, np.float32)
                    for name, value in values.items()
                }
            reach = float(np.float32(layer.inputs**-0.5))
            for name, shape in (("weight", (layer.outputs, layer.inputs)), ("bias", (layer.outputs,))):
                share = (twister.randint(0, 2**32, shape, np.uint32) % 2**24) * 2.0**-24
                arrays[f"{layer.name}.{name}"] = (2 * reach * share - reach).astype(np.float32)
        return Autoencoder(channels, latent, arrays)

    @staticmethod
    def from_arrays(channels: int, latent: int, arrays: dict[str, np.ndarray]) -> "Autoencoder":
        """Build a trained network from its saved weights.

        Raises:
            ValueError: if an array is missing or has another shape.
        """
        model = Autoencoder.drawn(channels, latent, torch_generator(0))
        for name, values in model.arrays.items():
            if name not in arrays or arrays[name].shape != values.shape:
                raise ValueError(f"{name} of shape {values.shape} is missing")
            model.arrays[name] = arrays[name]
        return model

    def save(self, path: Path) -> None:
        """Write a .safetensors file; equal weights give equal bytes."""
        write_tensors(path, self.arrays, channels=self.channels, latent=self.latent)
