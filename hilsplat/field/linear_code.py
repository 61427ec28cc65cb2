"""Linear code of CLIP vectors, their mean and principal directions: an alternative to the network."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from hilsplat.base.arrays import write_tensors


class LinearCode:
    """Code e = unit(m + U z) with d principal directions around the mean.

    It involves no training and no randomness. Unlike with a network, the code of an average is the average
    of the codes, and a cosine with any vector takes d products, so relevancy needs no decoding. A network,
    however, can adapt its d numbers nonlinearly to the vectors of the scene.

    Args:
        mean: m.
        basis: U, with orthonormal rows.
    """

    def __init__(self, mean: Float32[np.ndarray, " C"], basis: Float32[np.ndarray, "D C"]) -> None:
        self.mean, self.basis = mean, basis

    @property
    def channels(self) -> int:
        """C."""
        return self.basis.shape[1]

    @property
    def latent(self) -> int:
        """d."""
        return self.basis.shape[0]

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
        """Return vectors of unit length."""
        vectors = self.mean + latents @ self.basis
        return (vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)).astype(
            np.float32
        )

    def cosine_terms(self, vectors: Float32[np.ndarray, "V C"]) -> tuple:
        """Return the terms of cosines with decoded vectors.

        Returns:
            m.v and U v of each vector, |m|^2, and U m, so that e.v = (m.v + z.Uv) / |m + U z|.
        """
        return (
            (vectors @ self.mean).astype(np.float32),
            np.ascontiguousarray(vectors @ self.basis.T, np.float32),
            float(self.mean @ self.mean),
            (self.basis @ self.mean).astype(np.float32),
        )

    def save(self, path: Path) -> None:
        """Write a .safetensors file; equal codes give equal bytes."""
        arrays = {"mean": self.mean, "basis": self.basis}
        write_tensors(path, arrays, code="pca", channels=self.channels, latent=self.latent)
