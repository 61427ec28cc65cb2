"""Centroids by k-means, and product quantisation: vectors as one byte per part of theirs."""

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8
from scipy.cluster.vq import kmeans2, vq

ROUNDS = 20
"""Of Lloyd's iteration; the error falls by less than one per cent after them."""

BYTE = 256
"""Centroids of a part, so that a part is one byte."""


def centroids(vectors: Float32[np.ndarray, "B C"], count: int, seed: int) -> Float32[np.ndarray, "E C"]:
    """Centroids by k-means from distant starts (k-means++).

    Args:
        vectors: at least one; with no more different ones than `count`, those are the centroids.
        count: E.
        seed: of the starts.

    Returns:
        E centroids; missing ones repeat the first.
    """
    different = np.unique(vectors, axis=0)
    if len(different) <= count:
        return np.concatenate([different, np.repeat(different[:1], count - len(different), axis=0)])
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty")  # it keeps its last centroid
        found, _ = kmeans2(
            vectors.astype(np.float64), count, iter=ROUNDS, minit="++", rng=np.random.default_rng(seed)
        )
    return found.astype(np.float32)


@dataclass(frozen=True)
class ProductQuantiser:
    """A codebook for each part of a vector (Jegou et al., PAMI 2011).

    Attributes:
        codebooks: parts x centroids, at most 256, x numbers of a part.
    """

    codebooks: Float32[np.ndarray, "P E S"]

    @staticmethod
    def fit(vectors: Float32[np.ndarray, "B C"], part: int, seed: int) -> "ProductQuantiser":
        """Train on vectors, cut into parts of `part` numbers; the last is filled up with zeros."""
        pieces = _pieces(vectors, part)
        return ProductQuantiser(
            np.stack(
                [
                    centroids(np.ascontiguousarray(pieces[:, at]), BYTE, seed + at)
                    for at in range(pieces.shape[1])
                ]
            )
        )

    def encode(self, vectors: Float32[np.ndarray, "B C"]) -> UInt8[np.ndarray, "B P"]:
        """The nearest centroid of each part."""
        pieces = _pieces(vectors, self.codebooks.shape[2])
        return np.stack(
            [
                vq(pieces[:, at], book, check_finite=False)[0].astype(np.uint8)
                for at, book in enumerate(self.codebooks)
            ],
            axis=1,
        )

    def decode(self, codes: UInt8[np.ndarray, "B P"], channels: int) -> Float32[np.ndarray, "B C"]:
        """The centroids side by side."""
        parts = [book[codes[:, at]] for at, book in enumerate(self.codebooks)]
        return np.concatenate(parts, axis=1)[:, :channels]


def _pieces(vectors: Float32[np.ndarray, "B C"], part: int) -> Float32[np.ndarray, "B P S"]:
    missing = -vectors.shape[1] % part
    filled = np.pad(vectors, ((0, 0), (0, missing)))
    return filled.reshape(len(vectors), filled.shape[1] // part, part)
