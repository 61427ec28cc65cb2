"""The scene's code from CLIP vectors to a few numbers and back, by a network or linearly; reading it."""

from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from hilsplat.base.arrays import read_tensors
from hilsplat.base.artifacts import read_npz, remake, sealed
from hilsplat.base.errors import ArtifactError
from hilsplat.contributions.rows import Contributions
from hilsplat.field.linear_code import LinearCode
from hilsplat.segment.digests import require_same_masks

CHUNK_ROWS = 4096
"""Rows decoded at once: 4096 vectors of 128 numbers, 2 MiB, stay in the processor's cache."""


@runtime_checkable
class Code(Protocol):
    """Encoder and decoder of CLIP vectors: `linear_code.LinearCode` or `network_code.Autoencoder`."""

    @property
    def channels(self) -> int:
        """Width C of the CLIP vectors."""

    @property
    def latent(self) -> int:
        """Size d of a latent."""

    def encode_array(self, vectors: Float32[np.ndarray, "B C"]) -> Float32[np.ndarray, "B D"]:
        """Encode vectors as latents."""

    def decode_array(self, latents: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """Decode latents to vectors of unit length."""

    def save(self, path: Path) -> None:
        """Write a .safetensors file; equal codes give equal bytes."""


def load_code(folder: Path) -> Code:
    """Read the network or linear code of a finished folder.

    Raises:
        ArtifactError: if the file is missing or damaged.
    """
    path = autoencoder_file(folder)
    state, about = read_tensors(path)
    try:
        if about.get("code") == "pca":
            return LinearCode(state["mean"], state["basis"])
        from hilsplat.field.network_code import Autoencoder

        return Autoencoder.from_arrays(about["channels"], about["latent"], state)
    except (KeyError, ValueError) as error:
        raise ArtifactError(f"{path} is of another version: {error}", fix=remake(path)) from error


def autoencoder_file(folder: Path) -> Path:
    """Return the path of the weights in a finished folder."""
    return Path(folder) / "autoencoder.safetensors"


def load_latents(folder: Path, contributions: Contributions) -> Float32[np.ndarray, "M D"]:
    """Return the latent of each mask, in the contributions' row order.

    Raises:
        MisalignedArtifactError: if the latents belong to other masks.
    """
    require_same_masks(folder, contributions.folder)
    return read_npz(sealed(folder, "latents.npz"), "latents")["latents"]
