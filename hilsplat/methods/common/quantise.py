"""K-means, and product quantisation: vectors as one byte per part of theirs."""

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int64, UInt8
from scipy.cluster.vq import kmeans2, vq

ROUNDS = 20
"""Of Lloyd's iteration; the error falls by less than one per cent after them."""

BYTE = 256
"""Centroids of a part, so that a part is one byte."""


def kmeans(
    vectors: Float32[np.ndarray, "n C"], count: int, seed: int, rounds: int = ROUNDS
) -> tuple[Float32[np.ndarray, "E C"], Int64[np.ndarray, " n"]]:
    """Centroids by k-means from distant starts (k-means++), and the nearest of them for every vector.

    Args:
        vectors: any number; with no more different ones than `count`, those are the centroids.
        count: E.
        seed: of the starts.
        rounds: of Lloyd's iteration; a centroid that loses its last vector stays where it is.

    Returns:
        E centroids, of which missing ones repeat the first, and the row of the nearest for every vector.
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
    """Rows drawn by their squared distance from those before; scipy's own draw takes E times as long."""
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
                    kmeans(np.ascontiguousarray(pieces[:, at]), BYTE, seed + at)[0]
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
