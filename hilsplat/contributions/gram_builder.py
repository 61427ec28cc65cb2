"""Sum G over parts of W, in memory that grows only with G."""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from queue import SimpleQueue

import numpy as np
import scipy.sparse as sp

from hilsplat.base.levels import LEVELS
from hilsplat.contributions.gram_kernels import SUMS, add_to_block, enlarged, merge_rows, transpose
from hilsplat.contributions.quadratic import Gram, StackedWeights

BLOCKS = 64
"""G is built in this many blocks of rows, one per thread at a time; the result does not depend on it. Blocks
whose Gaussians a part does not show are skipped, which a Morton order makes frequent."""

MERGE_AT = 8
"""Late pairs of a block are merged with its rows once they exceed one in this many."""


class _Rows:
    """Some rows of G, in reused memory: first writes to new pages take time and memory."""

    def __init__(self, rows: int) -> None:
        self.indptr = np.zeros(rows + 1, np.int64)
        self._indices, self._values = np.empty(0, np.int32), np.empty((0, len(LEVELS)))

    @property
    def nonzeros(self) -> int:
        """Number of pairs of Gaussians."""
        return int(self.indptr[-1])

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return row starts, columns and values."""
        return self.indptr, self._indices[: self.nonzeros], self._values[: self.nonzeros]

    def replace(self, indptr: np.ndarray, indices: np.ndarray, values: np.ndarray) -> None:
        """Copy other rows over these; columns and values may have more entries than `indptr` uses."""
        kept = int(indptr[-1])
        self._make_room(kept, 0)
        self.indptr = indptr
        self._indices[:kept], self._values[:kept] = indices[:kept], values[:kept]

    def merge(self, late: "_Rows") -> None:
        """Add pairs that these rows don't contain."""
        self._make_room(self.nonzeros + late.nonzeros, self.nonzeros)
        merge_rows(self.indptr, self._indices, self._values, *late.arrays())

    def _make_room(self, needed: int, kept: int) -> None:
        if needed > len(self._indices):
            self._indices, self._values = enlarged(self._indices, self._values, kept, 2 * needed)


class _Block:
    """Rows of G, with the few pairs that were added late kept separately.

    A part shows a tenth of the Gaussians of a large scene. Sums of known pairs are updated in place, and only
    the late pairs are rewritten, until there are enough of them to merge.
    """

    def __init__(self, rows: int) -> None:
        self.rows, self.late = _Rows(rows), _Rows(rows)

    @property
    def nonzeros(self) -> int:
        """Number of pairs of Gaussians."""
        return self.rows.nonzeros + self.late.nonzeros

    def replace_late(self, indptr: np.ndarray, indices: np.ndarray, values: np.ndarray) -> None:
        """Replace the late pairs, and merge them if they are many."""
        self.late.replace(indptr, indices, values)
        if MERGE_AT * self.late.nonzeros > self.rows.nonzeros:
            self.merged()

    def merged(self) -> _Rows:
        """Merge the late pairs and return all pairs."""
        if self.late.nonzeros:
            self.rows.merge(self.late)
            self.late = _Rows(len(self.rows.indptr) - 1)
        return self.rows


class _Scratch:
    """Buffers that one thread needs to add to a block."""

    def __init__(self, num_gaussians: int) -> None:
        self.sums = np.zeros(num_gaussians * SUMS)
        self.fresh = np.empty(num_gaussians, np.int32)
        self.indices, self.values = np.empty(1024, np.int32), np.empty((1024, len(LEVELS)))


class GramBuilder:
    """Sum of G over parts of W, such as one view after another; its memory grows only with G.

    Entries are summed in float64 in the order of the pixels, so the bytes depend neither on the division of
    pixels into parts nor on the number of threads.

    Args:
        num_gaussians: N.
        threads: threads that share the blocks of rows.
    """

    def __init__(self, num_gaussians: int, threads: int) -> None:
        edges = np.linspace(0, num_gaussians, BLOCKS + 1).astype(np.int64).tolist()
        self._ranges = list(pairwise(edges))
        self._threads = max(1, threads)
        self._pixels = self._places = np.zeros(0, np.int32)
        self._blocks = [_Block(end - begin) for begin, end in self._ranges]
        self._idle: SimpleQueue[_Scratch] = SimpleQueue()
        for _ in range(self._threads):
            self._idle.put(_Scratch(num_gaussians))

    @property
    def nonzeros(self) -> int:
        """Number of pairs of Gaussians so far."""
        return sum(block.nonzeros for block in self._blocks)

    def add(self, part: StackedWeights) -> None:
        """Add W' diag(valid) W of further pixels; the columns of W must be sorted within rows."""
        weights = part.weights
        arrays = (weights.indptr, weights.indices, weights.data, part.valid)
        columns = self._columns(weights)

        def grow(number: int) -> None:
            begin, end = self._ranges[number]
            if columns[0][begin] == columns[0][end]:
                return
            block, own, indptr = self._blocks[number], self._idle.get(), np.zeros(end - begin + 1, np.int64)
            known = block.rows.arrays(), block.late.arrays()
            scratch = own.sums, own.fresh, indptr, own.indices, own.values
            own.indices, own.values = add_to_block(begin, end, arrays, columns, *known, *scratch)
            block.replace_late(indptr, own.indices, own.values)
            self._idle.put(own)

        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(grow, range(len(self._blocks))))

    def _columns(self, weights: sp.csr_matrix) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return each Gaussian's weights in W: start of its list, and lists of pixels and places.

        From such a place on, the pixel's row of W contains the columns of the upper triangle. The lists are
        reused for the next part, because allocating memory takes longer than filling it.
        """
        dtype = np.int32 if weights.nnz < 2**31 else np.int64
        if len(self._places) < weights.nnz or self._places.dtype != dtype:
            self._pixels = np.empty(weights.nnz * 9 // 8, np.int32)
            self._places = np.empty(len(self._pixels), dtype)
        begins = np.zeros(weights.shape[1] + 1, np.int64)
        transpose(weights.indptr, weights.indices, begins, self._pixels, self._places)
        return begins, self._pixels, self._places

    def state(self) -> dict[str, np.ndarray]:
        """Return everything summed so far as arrays."""
        names = ("indptr", "indices", "values")
        return {
            f"{name}_{number}": array
            for number, block in enumerate(self._blocks)
            for name, array in zip(names, block.merged().arrays(), strict=True)
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from `state`."""
        for number, block in enumerate(self._blocks):
            block.rows.replace(*(state[f"{name}_{number}"] for name in ("indptr", "indices", "values")))

    def finish(self) -> Gram:
        """Return G of everything added, and empty the builder."""
        indptr = np.zeros(self._ranges[-1][1] + 1, np.int64)
        indices = np.empty(self.nonzeros, np.int32)
        values = np.empty((len(indices), len(LEVELS)), np.float32)
        done = 0
        for number, (begin, end) in enumerate(self._ranges):
            some_indptr, some_indices, some_values = self._blocks[number].merged().arrays()
            self._blocks[number] = _Block(end - begin)
            indptr[begin + 1 : end + 1] = some_indptr[1:] + done
            indices[done : done + len(some_indices)] = some_indices
            values[done : done + len(some_indices)] = some_values
            done += len(some_indices)
        return Gram(indptr, indices, values)
