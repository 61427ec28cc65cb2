"""The quadratic form of frozen geometry: G_l = sum over views of W' diag(valid_l) W.

W holds the compositing weights of all pixels that have a mask at some level. G is stored once for
all levels, as an upper triangle with three values per pair of Gaussians; where W has fewer
non-zeros, W is kept and streamed instead. Both give the same products.
"""

import inspect
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numba
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32

from hilsplat.base.artifacts import read_npz, write_npz
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import LEVELS

BLOCKS = 16
"""Blocks of rows in which G is built, one a thread at a time; the result does not depend on it."""

CHUNK_WEIGHTS = 2**25
"""Non-zeros of W that are gathered before they are added to G; 0.7 GiB while they are."""

MAX_WEIGHTS = 2**28
"""Non-zeros up to which W of all views is held in memory, 2 GiB."""


def compiled(function: Callable, **options: bool) -> Callable:
    """Compile a loop with numba (unwrapped: the tests' type checker wraps every function)."""
    return numba.njit(cache=True, nogil=True, **options)(inspect.unwrap(function))


@dataclass(frozen=True)
class Gram:
    """Upper triangle of G for all levels, with one pattern.

    Attributes:
        pairs: CSR pattern (N, N), columns from the diagonal on; its data are not used.
        values: G of each level at each pair of the pattern, float32.
    """

    indptr: np.ndarray
    indices: np.ndarray
    values: Float32[np.ndarray, "E 3"]

    @property
    def nonzeros(self) -> int:
        """Stored pairs of Gaussians."""
        return len(self.indices)

    @property
    def num_gaussians(self) -> int:
        """N."""
        return len(self.indptr) - 1

    def product(self, features: Float32[np.ndarray, "N 3 D"]) -> Float32[np.ndarray, "N 3 D"]:
        """G_l F_l for every level; one thread, always summed in the same order."""
        out = np.zeros_like(features)
        _gram_product(self.indptr, self.indices, self.values, np.ascontiguousarray(features), out)
        return out

    def save(self, path: Path) -> None:
        """Write `G.npz`."""
        write_npz(path, indptr=self.indptr, indices=self.indices, values=self.values)


@dataclass(frozen=True)
class StackedWeights:
    """W of all labelled pixels of all views, and at which levels each pixel has a mask.

    Attributes:
        weights: CSR (P, N); rows sum to 1.
        valid: whether a pixel has a mask at each level.
    """

    weights: sp.csr_matrix
    valid: Bool[np.ndarray, "P 3"]

    @property
    def nonzeros(self) -> int:
        """Stored weights."""
        return self.weights.nnz

    @property
    def num_gaussians(self) -> int:
        """N."""
        return self.weights.shape[1]

    def product(self, features: Float32[np.ndarray, "N 3 D"]) -> Float32[np.ndarray, "N 3 D"]:
        """W' diag(valid_l) W F_l for every level; one thread, always summed in the same order."""
        out = np.zeros_like(features)
        _weights_product(
            self.weights.indptr,
            self.weights.indices,
            self.weights.data,
            self.valid,
            np.ascontiguousarray(features),
            out,
        )
        return out

    def save(self, path: Path) -> None:
        """Write `W.npz`."""
        write_npz(
            path,
            indptr=self.weights.indptr,
            indices=self.weights.indices,
            data=self.weights.data,
            columns=np.array([self.weights.shape[1]]),
            valid=self.valid,
        )


Quadratic = Gram | StackedWeights


def level_mass(quadratic: Quadratic) -> Float32[np.ndarray, "N 3"]:
    """Visible mass of each Gaussian in the labelled pixels of each level: G_l 1, as rows of W sum to 1."""
    ones = np.ones((quadratic.num_gaussians, len(LEVELS), 1), np.float32)
    return quadratic.product(ones)[:, :, 0]


class GramBuilder:
    """Sums G over parts of W, such as one view's after another; memory grows with G alone.

    Entries are summed in float64 in the order of the pixels, so the bytes depend neither on how the
    pixels were parted nor on the number of threads.

    Args:
        num_gaussians: N.
        threads: blocks of rows are shared among them.
    """

    def __init__(self, num_gaussians: int, threads: int) -> None:
        edges = np.linspace(0, num_gaussians, BLOCKS + 1).astype(np.int64).tolist()
        self._ranges = list(pairwise(edges))
        self._threads = max(1, threads)
        self._blocks = [
            (np.zeros(end - begin + 1, np.int64), np.zeros(0, np.int32), np.zeros((0, len(LEVELS))))
            for begin, end in self._ranges
        ]

    @property
    def nonzeros(self) -> int:
        """Pairs of Gaussians so far."""
        return sum(len(indices) for _, indices, _ in self._blocks)

    def add(self, part: StackedWeights) -> None:
        """Add W' diag(valid) W of further pixels; columns of W are sorted within rows."""
        weights = part.weights
        # The transposed matrix holds positions in W: from there on lie the columns of the upper triangle.
        positions = sp.csr_matrix(
            (np.arange(weights.nnz, dtype=np.int64), weights.indices, weights.indptr), shape=weights.shape
        ).tocsc()
        arrays = (weights.indptr, weights.indices, weights.data, part.valid)
        columns = (positions.indptr, positions.indices, positions.data)

        def grow(block: int) -> None:
            self._blocks[block] = _grown_block(
                *self._ranges[block], *arrays, *columns, *self._blocks[block], len(LEVELS)
            )

        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(grow, range(len(self._blocks))))

    def finish(self) -> Gram:
        """G of everything added; the builder is empty afterwards."""
        indptr = np.zeros(self._ranges[-1][1] + 1, np.int64)
        indices = np.empty(self.nonzeros, np.int32)
        values = np.empty((len(indices), len(LEVELS)), np.float32)
        done = 0
        for (begin, end), block in zip(self._ranges, range(len(self._blocks)), strict=True):
            some_indptr, some_indices, some_values = self._blocks[block]
            self._blocks[block] = (np.zeros(1, np.int64), some_indices[:0], some_values[:0])
            indptr[begin + 1 : end + 1] = some_indptr[1:] + done
            indices[done : done + len(some_indices)] = some_indices
            values[done : done + len(some_indices)] = some_values
            done += len(some_indices)
        return Gram(indptr, indices, values)


class QuadraticBuilder:
    """Collects W part by part and keeps whichever of G and W has fewer non-zeros.

    One product touches each of them equally often. W is let go of as soon as it has more non-zeros
    than `MAX_WEIGHTS`, and G is kept then.

    Args:
        num_gaussians: N.
        keep: "auto", or "gram" or "weights" to insist on one.
        threads: for building G.
    """

    def __init__(self, num_gaussians: int, keep: str, threads: int) -> None:
        self._gram = None if keep == "weights" else GramBuilder(num_gaussians, threads)
        self._keeps_weights = keep != "gram"
        self._may_drop = keep == "auto"
        self._parts: list[StackedWeights] = []
        self._waiting: list[StackedWeights] = []
        self.weights_nonzeros = 0

    def add(self, part: StackedWeights) -> None:
        """Add the labelled pixels of a view."""
        self.weights_nonzeros += part.nonzeros
        if self._may_drop and self.weights_nonzeros > MAX_WEIGHTS:
            self._parts, self._keeps_weights = [], False
        if self._keeps_weights:
            self._parts.append(part)
        if self._gram is not None:
            self._waiting.append(part)
            if sum(each.nonzeros for each in self._waiting) >= CHUNK_WEIGHTS:
                self._gram.add(stack_weights(self._waiting))
                self._waiting = []

    def finish(self) -> Quadratic:
        """G or W of everything added."""
        if self._gram is None:
            return stack_weights(self._parts)
        if self._waiting:
            self._gram.add(stack_weights(self._waiting))
            self._waiting = []
        if self._keeps_weights and self.weights_nonzeros < self._gram.nonzeros:
            return stack_weights(self._parts)
        return self._gram.finish()


def stack_weights(parts: list[StackedWeights]) -> StackedWeights:
    """One after the other."""
    if len(parts) == 1:
        return parts[0]
    matrix = sp.vstack([part.weights for part in parts], format="csr")
    return StackedWeights(matrix, np.concatenate([part.valid for part in parts]))


def load_quadratic(folder: Path) -> Quadratic:
    """Read `G.npz` or `W.npz`, whichever the contributions stage kept.

    Raises:
        ArtifactError: neither is there.
    """
    if (folder / "G.npz").is_file():
        return Gram(**read_npz(folder / "G.npz"))
    if (folder / "W.npz").is_file():
        arrays = read_npz(folder / "W.npz")
        shape = (len(arrays["indptr"]) - 1, int(arrays["columns"][0]))
        matrix = sp.csr_matrix((arrays["data"], arrays["indices"], arrays["indptr"]), shape=shape)
        return StackedWeights(matrix, arrays["valid"])
    raise ArtifactError(f"{folder} holds neither G.npz nor W.npz", fix="run the contributions stage again")


@compiled
def _gram_product(indptr, indices, values, features, out):
    levels, channels = features.shape[1], features.shape[2]
    for i in range(len(indptr) - 1):
        for k in range(indptr[i], indptr[i + 1]):
            j = indices[k]
            for level in range(levels):
                value = values[k, level]
                for c in range(channels):
                    out[i, level, c] += value * features[j, level, c]
                if j != i:
                    for c in range(channels):
                        out[j, level, c] += value * features[i, level, c]


@compiled
def _weights_product(indptr, indices, data, valid, features, out):
    levels, channels = features.shape[1], features.shape[2]
    rendered = np.zeros((levels, channels), np.float32)
    for p in range(len(indptr) - 1):
        rendered[:] = 0
        for k in range(indptr[p], indptr[p + 1]):
            j, weight = indices[k], data[k]
            for level in range(levels):
                if valid[p, level]:
                    for c in range(channels):
                        rendered[level, c] += weight * features[j, level, c]
        for k in range(indptr[p], indptr[p + 1]):
            j, weight = indices[k], data[k]
            for level in range(levels):
                if valid[p, level]:
                    for c in range(channels):
                        out[j, level, c] += weight * rendered[level, c]


@compiled
def _grown_block(
    begin,
    end,
    indptr,
    indices,
    data,
    valid,
    col_indptr,
    col_rows,
    col_positions,
    old_indptr,
    old_indices,
    old_values,
    levels,
):
    """Rows begin..end of G with the new pixels added to the old values; columns sorted."""
    num = len(col_indptr) - 1
    seen = np.full(num, -1, np.int64)
    sums = np.zeros((num, levels), np.float64)
    found = np.empty(num, np.int32)
    out_indptr = np.zeros(end - begin + 1, np.int64)
    out_indices = np.empty(max(1024, 2 * len(old_indices)), np.int32)
    out_values = np.empty((len(out_indices), levels), np.float64)
    done = 0
    for i in range(begin, end):
        count = 0
        for k in range(old_indptr[i - begin], old_indptr[i - begin + 1]):
            j = old_indices[k]
            seen[j] = i
            found[count] = j
            count += 1
            for level in range(levels):
                sums[j, level] = old_values[k, level]
        known = count
        for t in range(col_indptr[i], col_indptr[i + 1]):
            p = col_rows[t]
            weight = np.float64(data[col_positions[t]])
            whole = weight if valid[p, 0] else 0.0
            part = weight if valid[p, 1] else 0.0
            subpart = weight if valid[p, 2] else 0.0
            for k in range(col_positions[t], indptr[p + 1]):
                j = indices[k]
                if seen[j] != i:
                    seen[j] = i
                    sums[j] = 0
                    found[count] = j
                    count += 1
                value = np.float64(data[k])
                sums[j, 0] += whole * value
                sums[j, 1] += part * value
                sums[j, 2] += subpart * value
        if count > known:
            found[:count] = np.sort(found[:count])
        if done + count > len(out_indices):
            room = 2 * (done + count)
            more_indices, more_values = np.empty(room, np.int32), np.empty((room, levels), np.float64)
            more_indices[:done], more_values[:done] = out_indices[:done], out_values[:done]
            out_indices, out_values = more_indices, more_values
        for place in range(count):
            out_indices[done + place] = found[place]
            for level in range(levels):
                out_values[done + place, level] = sums[found[place], level]
        done += count
        out_indptr[i - begin + 1] = done
    return out_indptr, out_indices[:done].copy(), out_values[:done].copy()
