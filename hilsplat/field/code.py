"""The scene's code, which maps CLIP vectors to a few numbers and back, and the language field of codes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

from hilsplat.base.arrays import build_checked, read_tensors, require_types, write_tensors
from hilsplat.base.artifacts import read_npz, readable, sealed
from hilsplat.contributions.rows import Contributions
from hilsplat.field.decoder_kernels import UNITS, through_layers
from hilsplat.segment.digests import require_same_masks

CHUNK_ROWS = 4096  # rows decoded at once: 4096 vectors of 128 numbers (2 MiB) fit in the processor's cache
ENCODER_WIDTHS = (256, 128, 64, 32)
DECODER_WIDTHS = (16, 32, 64, 128, 256, 256)
NORM_EPS = 1e-5  # epsilon added to the variances of BatchNorm, as in torch


class LinearCode:
    """Code e = unit(m + U z) with d principal directions about the mean.

    m is the mean, and U the basis with orthonormal rows. The code needs no training and no randomness. The
    code of an average is the average of the codes, and a cosine with any vector takes d products, so
    relevancy needs no decoding. A network has neither property, but adapts nonlinearly to the vectors.
    """

    def __init__(self, mean: Float32[np.ndarray, " C"], basis: Float32[np.ndarray, "D C"]) -> None:
        self.mean, self.basis = mean, basis
        self.latent, self.channels = basis.shape

    @staticmethod
    def fit(vectors: Float32[np.ndarray, "B C"], latent: int) -> "LinearCode":
        """Compute the principal directions of the vectors; each direction's largest component is positive.

        If the vectors span fewer than d directions, the remaining ones are arbitrary.
        """
        data = vectors.astype(np.float64)
        mean = data.mean(axis=0)
        centred = data - mean
        _, directions = np.linalg.eigh(np.einsum("bc,bd->cd", centred, centred))
        basis = directions[:, ::-1][:, :latent].T
        peak = np.abs(basis).argmax(axis=1)
        basis = basis * np.sign(basis[np.arange(len(basis)), peak])[:, None]
        return LinearCode(mean.astype(np.float32), basis.astype(np.float32))

    def encode_array(self, vectors: Float32[np.ndarray, "B C"]) -> Float32[np.ndarray, "B D"]:
        """Return the coordinates along the directions."""
        return ((vectors - self.mean) @ self.basis.T).astype(np.float32)

    def decode_array(self, latents: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """Decode latents to vectors of unit length."""
        return unit_rows(self.mean + latents @ self.basis)

    def cosine_terms(self, vectors: Float32[np.ndarray, "V C"]) -> tuple[Any, ...]:
        """Return m.v and U v of each vector, |m|^2, and U m, so that e.v = (m.v + z.Uv) / |m + U z|."""
        return (
            (vectors @ self.mean).astype(np.float32),
            np.ascontiguousarray(vectors @ self.basis.T, np.float32),
            float(self.mean @ self.mean),
            (self.basis @ self.mean).astype(np.float32),
        )

    def save(self, path: Path) -> None:
        """Write a .safetensors file; identical codes produce identical bytes."""
        arrays = {"mean": self.mean, "basis": self.basis}
        write_tensors(path, arrays, code="pca", channels=self.channels, latent=self.latent)


class Layer(NamedTuple):
    """A linear layer, with the normalisation and activation before it."""

    name: str  # name of the layer's weights in the file
    norm: str  # name of the BatchNorm before the layer; empty if there is none
    relu: bool  # whether a ReLU is applied to the layer's inputs, after the BatchNorm
    inputs: int
    outputs: int


def layers_of(channels: int, latent: int) -> tuple[list[Layer], list[Layer]]:
    """Return the layers of the encoder and the decoder; no layer is wider than the vectors."""
    inner, outer = ([min(width, channels) for width in sizes] for sizes in (ENCODER_WIDTHS, DECODER_WIDTHS))
    # names follow the numbering of torch's nn.Sequential, which also counts norms and ReLUs
    encoder = [
        Layer(f"encoder.{3 * k}", f"encoder.{3 * k - 2}" if k else "", k > 0, *sizes)
        for k, sizes in enumerate(pairwise([channels, *inner, latent]))
    ]
    decoder = [
        Layer(f"decoder.{2 * k}", "", k > 0, *sizes)
        for k, sizes in enumerate(pairwise([latent, *outer, channels]))
    ]
    return encoder, decoder


def unit_rows(rows: Float[np.ndarray, "B C"]) -> Float[np.ndarray, "B C"]:
    """Scale rows to length 1; a row of zeros is unchanged."""
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)


class PackedLayers(NamedTuple):
    """Dense layers with ReLUs between them, in the memory layout that the compiled loops need.

    Such a network is affine where no ReLU changes sign. Pixels of an object have similar latents, so most
    pixels of a view share a few hundred of these affine pieces. A piece is given by the network's value and
    derivatives at one latent, its anchor. It contains all latents for which every hidden unit has the sign
    that it has at the anchor, and decodes them exactly in a tenth of the network's time.

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


class Autoencoder:
    """LangSplat's scene autoencoder, C -> 256 -> 128 -> 64 -> 32 -> d and back, unit length at both ends.

    Departs: layer widths never exceed C. The encoder's BatchNorm (better in tests than LayerNorm or no norm)
    is trained only on full batches and then uses the statistics of all vectors: see
    `autoencoder.train_autoencoder`. Arrays have the names and layout of torch's modules.
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
        return unit_rows(values)

    def decode_array(self, latents: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """Decode latents of any length to vectors of unit length."""
        return self._packed_decoder.through(latents)

    def _affine(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        return self.arrays[f"{name}.weight"], self.arrays[f"{name}.bias"]

    @cached_property
    def _packed_decoder(self) -> PackedLayers:
        return PackedLayers.of([self._affine(layer.name) for layer in self._decoder])

    @staticmethod
    def initial(channels: int, latent: int, twister: np.random.RandomState) -> "Autoencoder":
        """Draw the weights that torch draws from this generator state; BatchNorm starts as the identity."""
        arrays: dict[str, np.ndarray] = {}
        for layer in (layer for side in layers_of(channels, latent) for layer in side):
            if layer.norm:
                values = {"weight": 1, "bias": 0, "running_mean": 0, "running_var": 1}
                for name, value in values.items():
                    arrays[f"{layer.norm}.{name}"] = np.full(layer.inputs, value, np.float32)
            reach = float(np.float32(layer.inputs**-0.5))
            for name, shape in (("weight", (layer.outputs, layer.inputs)), ("bias", (layer.outputs,))):
                share = (twister.randint(0, 2**32, shape, np.uint32) % 2**24) * 2.0**-24
                arrays[f"{layer.name}.{name}"] = (2 * reach * share - reach).astype(np.float32)
        return Autoencoder(channels, latent, arrays)

    def save(self, path: Path) -> None:
        """Write a .safetensors file; identical weights produce identical bytes."""
        write_tensors(path, self.arrays, channels=self.channels, latent=self.latent)


Code = LinearCode | Autoencoder


def load_code(folder: Path) -> Code:
    """Read the code (network or linear) in a finished folder; raise ArtifactError if missing or damaged."""
    path = autoencoder_file(folder)
    state, about = read_tensors(path)
    with readable(path, "is from a different version"):
        if about.get("code") == "pca":
            return LinearCode(state["mean"], state["basis"])
        model = Autoencoder.initial(about["channels"], about["latent"], np.random.RandomState(0))
        for name, values in model.arrays.items():
            if name not in state or state[name].shape != values.shape:
                raise ValueError(f"array {name} of shape {values.shape} is missing")
            model.arrays[name] = state[name]
        return model


def autoencoder_file(folder: Path) -> Path:
    return Path(folder) / "autoencoder.safetensors"


def load_latents(folder: Path, contributions: Contributions) -> Float32[np.ndarray, "M D"]:
    """Return the latent of each mask, in the contributions' row order.

    Raises:
        MisalignedArtifactError: the latents belong to different masks.
    """
    require_same_masks(folder, contributions.folder)
    return read_npz(sealed(folder, "latents.npz"), "latents")["latents"]


@dataclass(frozen=True)
class LanguageField:
    """One latent per Gaussian and level."""

    # latents of N Gaussians at three levels, coarse to fine; 0 for no latent
    features: Float32[np.ndarray, "N 3 D"]
    gaussians_sha256: str  # digest of the Gaussians' PLY
    autoencoder_sha256: str  # digest of the code that decodes the latents

    def save(self, path: Path) -> None:
        """Write `field.safetensors` atomically; identical fields produce identical bytes."""
        require_types(LanguageField, vars(self), path, {})
        about = {"gaussians_sha256": self.gaussians_sha256, "autoencoder_sha256": self.autoencoder_sha256}
        write_tensors(path, {"features": self.features}, **about)

    @staticmethod
    def load(path: Path) -> "LanguageField":
        """Read `field.safetensors`; raise ArtifactError if it is missing, damaged or not a language field."""
        return build_checked(LanguageField, *read_tensors(path), path)
