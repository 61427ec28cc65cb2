"""K-means and product quantisation, which stores a vector as one byte per part."""

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int64, UInt8
from scipy.cluster.vq import kmeans2, vq

ROUNDS = 20
"""Lloyd iterations; further ones reduce the error by less than 1 %."""

BYTE = 256
"""Centroids per part, so that each part is stored in one byte."""


def kmeans(
    vectors: Float32[np.ndarray, "n C"], count: int, seed: int, rounds: int = ROUNDS
) -> tuple[Float32[np.ndarray, "E C"], Int64[np.ndarray, " n"]]:
    """Return centroids by k-means from distant starts (k-means++), and each vector's nearest centroid.

    Args:
        vectors: data; if at most `count` are distinct, those are the centroids.
        count: E.
        seed: seed of the starts.
        rounds: Lloyd iterations; a centroid that loses its last vector keeps its position.

    Returns:
        E centroids, the first one repeated if there are fewer, and the row of each vector's nearest.
    """
    if not len(vectors):
        return np.zeros((count, vectors.shape[1]), np.float32), np.zeros(0, np.int64)
    data = vectors.astype(np.float64)
    starts = _distant_rows(data, count, np.random.default_rng(seed))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty")
        found, _ = kmeans2(data, starts, iter=rounds, minit="matrix")
    return found.astype(np.float32), vq(data, found, check_finite=False)[0].astype(np.int64)


def _distant_rows(
    data: Float[np.ndarray, "n C"], count: int, random: np.random.Generator
) -> Float[np.ndarray, "E C"]:
    """Draw rows by squared distance from previous ones; scipy's own sampling takes E times as long."""
    chosen = np.full(count, -1, np.int64)
    square, chances = np.full(len(data), np.inf), np.arange(1.0, len(data) + 1)
    for place in range(count):
        if chances[-1] == 0:
            break  # every row is a start already
        draw = random.random() * chances[-1]
        chosen[place] = min(int(np.searchsorted(chances, draw, side="right")), len(data) - 1)
        np.minimum(square, np.square(data - data[chosen[place]]).sum(axis=1), out=square)
        chances = square.cumsum()
    return data[np.where(chosen < 0, chosen[0], chosen)]


@dataclass(frozen=True)
class ProductQuantiser:
    """One codebook for each part of a vector (Jegou et al., PAMI 2011).

    Attributes:
        codebooks: parts x centroids (at most 256) x elements of a part.
    """

    codebooks: Float32[np.ndarray, "P E S"]

    @staticmethod
    def fit(vectors: Float32[np.ndarray, "B C"], part: int, seed: int) -> "ProductQuantiser":
        """Train on vectors split into parts of `part` elements; the last is padded with zeros."""
        pieces = _pieces(vectors, part)
        return ProductQuantiser(
            np.stack(
                [
                    kmeans(np.ascontiguousarray(pieces[:, at]), BYTE, seed + at)[0]
                    for at in range(pieces.shape[1])
                ]
            )
        )

    def encode(self, vectors: Float32[np.ndarray, "B C"]) -> UInt8[np.ndarray, "B P"]:
        """Return the index of each part's nearest centroid."""
        pieces = _pieces(vectors, self.codebooks.shape[2])
        return np.stack(
            [
                vq(pieces[:, at], book, check_finite=False)[0].astype(np.uint8)
                for at, book in enumerate(self.codebooks)
            ],
            axis=1,
        )

    def decode(self, codes: UInt8[np.ndarray, "B P"], channels: int) -> Float32[np.ndarray, "B C"]:
        """Return the concatenated centroids."""
        parts = [book[codes[:, at]] for at, book in enumerate(self.codebooks)]
        return np.concatenate(parts, axis=1)[:, :channels]


def _pieces(vectors: Float32[np.ndarray, "B C"], part: int) -> Float32[np.ndarray, "B P S"]:
    missing = -vectors.shape[1] % part
    filled = np.pad(vectors, ((0, 0), (0, missing)))
    return filled.reshape(len(vectors), filled.shape[1] // part, part)
