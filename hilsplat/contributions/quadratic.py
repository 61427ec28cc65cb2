"""The quadratic form of frozen geometry: G_l = sum over views of W' diag(valid_l) W.

W contains the compositing weights of all pixels that have a mask at any level. G is stored once for all
levels, as an upper triangle with three values per pair of Gaussians. If W has fewer non-zeros, W is stored
and streamed instead, with the same products.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32

from cpusplat.threads import over_edges
from hilsplat.base.levels import LEVELS
from hilsplat.contributions.compositing import padded
from hilsplat.contributions.kernels import gram_across, gram_product, weights_product

PRODUCT_PARTS = 4
"""A product with G is summed in this many parts with equal numbers of pairs. The number is fixed so that
results don't depend on the number of threads; each part stores the sums of its rows and of all rows below."""


@dataclass(frozen=True)
class Gram:
    """Upper triangle of G for all levels in one CSR pattern (N, N); a row's columns start at the diagonal.

    A block is a range of rows of the same arrays. Column `first` is that of its first row, and columns beyond
    its last row belong to other blocks.
    """

    indptr: np.ndarray
    indices: np.ndarray
    values: Float32[np.ndarray, "E 3"]
    threads: int = 1
    first: int = 0

    @property
    def nonzeros(self) -> int:
        return len(self.indices)

    @property
    def num_gaussians(self) -> int:
        return len(self.indptr) - 1

    def product(self, features: Float32[np.ndarray, "N 3 D"]) -> Float32[np.ndarray, "N 3 D"]:
        """Return G_l F_l for every level; the order of sums is fixed."""
        wide = padded(features)
        width = wide.shape[2]
        shares = np.linspace(self.indptr[0], self.indptr[-1], PRODUCT_PARTS + 1)[1:-1]
        edges = [0, *np.searchsorted(self.indptr, shares).tolist(), self.num_gaussians]

        def part(begin: int, end: int) -> np.ndarray:
            out = np.zeros_like(wide[begin:])
            rows = begin, end, self.first, self.indptr, self.indices, self.values
            gram_product(*rows, wide.reshape(-1), width, out.reshape(-1))
            return out

        parts = over_edges(part, edges, self.threads)
        total = parts[0]
        for begin, sums in zip(edges[1:-1], parts[1:], strict=True):
            total[begin:] += sums
        return np.ascontiguousarray(total[:, :, : features.shape[2]])

    def block(self, begin: int, end: int) -> "Gram":
        """Return the rows and columns begin..end of the whole G, without copying them."""
        return Gram(self.indptr[begin : end + 1], self.indices, self.values, self.threads, begin)

    def across(
        self, begin: int, end: int, features: Float32[np.ndarray, "N 3 D"]
    ) -> Float32[np.ndarray, "n 3 D"]:
        """Return the product of the rows begin..end of the whole G with the features of all other rows."""
        out = np.zeros((end - begin, *features.shape[1:]), np.float32)
        gram_across(begin, end, self.indptr, self.indices, self.values, features, out)
        return out

    def save(self, folder: Path) -> None:
        """Write the folder `G`, whose arrays are memory-mapped when read."""
        _save(folder / "G", indptr=self.indptr, indices=self.indices, values=self.values)


@dataclass(frozen=True)
class StackedWeights:
    """W (P x N, rows sum to 1) of labelled pixels, and whether each pixel has a mask at each level."""

    weights: sp.csr_matrix
    valid: Bool[np.ndarray, "P 3"]
    threads: int = 1

    @property
    def nonzeros(self) -> int:
        return self.weights.nnz

    @property
    def num_gaussians(self) -> int:
        return self.weights.shape[1]

    def product(self, features: Float32[np.ndarray, "N 3 D"]) -> Float32[np.ndarray, "N 3 D"]:
        """Return W' diag(valid_l) W F_l for every level; the order of sums is fixed."""
        return self._product(0, self.num_gaussians, features, False)

    def block(self, begin: int, end: int) -> "StackedWeights":
        """Return the weights of Gaussians begin..end."""
        if end - begin == self.num_gaussians:
            return self
        return replace(self, weights=self.weights[:, begin:end])

    def across(
        self, begin: int, end: int, features: Float32[np.ndarray, "N 3 D"]
    ) -> Float32[np.ndarray, "n 3 D"]:
        """Return the product of the rows begin..end of G with the features of all other rows."""
        return self._product(begin, end, features, True)

    def _product(self, begin: int, end: int, features: np.ndarray, across: bool) -> np.ndarray:
        wide, W = padded(features), self.weights
        out = np.zeros((end - begin, *wide.shape[1:]), np.float32)
        rows = begin, across, W.indptr, W.indices, W.data, self.valid
        flat = wide.reshape(-1), wide.shape[2], out.reshape(-1)
        over_edges(weights_product, list(range(len(LEVELS) + 1)), self.threads, *rows, *flat)
        return np.ascontiguousarray(out[:, :, : features.shape[2]])

    def save(self, folder: Path) -> None:
        """Write the folder `W`, whose arrays are memory-mapped when read."""
        W = self.weights
        arrays = {"indptr": W.indptr, "indices": W.indices, "data": W.data, "valid": self.valid}
        _save(folder / "W", columns=np.array([self.num_gaussians]), **arrays)


Quadratic = Gram | StackedWeights


def form(quadratic: Quadratic, features: Float32[np.ndarray, "N 3 D"]) -> float:
    """Return the sum over levels of tr F'GF, in float64 except for G F, whose rounding errors cancel."""
    return float(np.multiply(features, quadratic.product(features), dtype=np.float64).sum())


Blocks = Sequence[tuple[int, int]]  # ranges of Gaussians that together contain each once, in order


def level_mass(quadratic: Quadratic, blocks: Blocks) -> Float32[np.ndarray, "N 3"]:
    """Return each Gaussian's visible mass in the labelled pixels of each level: G_l 1 (W's rows sum to 1)."""
    ones = np.ones((quadratic.num_gaussians, len(LEVELS), 1), np.float32)
    if len(blocks) == 1:
        return quadratic.product(ones)[:, :, 0]
    parts = []
    for begin, end in blocks:
        parts.append(quadratic.block(begin, end).product(ones[begin:end])[:, :, 0])
        parts[-1] += quadratic.across(begin, end, ones)[:, :, 0]
    return np.concatenate(parts)


def _save(folder: Path, **arrays: np.ndarray) -> None:
    folder.mkdir(parents=True)
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", np.ascontiguousarray(array), allow_pickle=False)
