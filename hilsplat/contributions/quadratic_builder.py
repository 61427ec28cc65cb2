"""Sum the quadratic form of frozen geometry part by part in bounded memory; choose G or W."""

import logging
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import scipy.sparse as sp

from hilsplat.base.arrays import Scratch
from hilsplat.base.artifacts import INDEX, read_index, read_npy, sealed, write_index
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import LEVELS
from hilsplat.base.lineage import sha256_of_json
from hilsplat.base.removal import DIGEST, delete
from hilsplat.contributions.kernels import SUMS, add_to_block, merge_rows, transpose
from hilsplat.contributions.quadratic import Gram, Quadratic, StackedWeights

logger = logging.getLogger(__name__)

BLOCKS = 64
"""G is built in this many blocks of rows, one per thread at a time; any number gives the same result. Blocks
that contain no Gaussian visible in a part are skipped, which Morton order makes frequent."""

MERGE_AT = 8
"""A block's late pairs are merged with its rows once they exceed its row pairs divided by this number."""

MAX_WEIGHTS = 2**28  # maximum number of non-zeros of W (all views) in memory, 2 GiB

CLEARLY_MORE = 2
"""W is dropped once it has this many times as many non-zeros as G, which grows more slowly with the views."""

CHECKPOINT_SECONDS = 300.0  # seconds between checkpoints of a long pass; short passes write none

ROWS = ("indptr", "indices", "values")


class _Rows:
    """A range of rows of G; memory is reused, because first writes to new pages take time and memory."""

    def __init__(self, rows: int, arrays: Scratch) -> None:
        self.indptr, self._empty = np.zeros(rows + 1, np.int64), arrays.empty
        self._indices, self._values = np.empty(0, np.int32), np.empty((0, len(LEVELS)))

    @property
    def nonzeros(self) -> int:
        return int(self.indptr[-1])

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.indptr, self._indices[: self.nonzeros], self._values[: self.nonzeros]

    def replace(self, indptr: np.ndarray, indices: np.ndarray, values: np.ndarray) -> None:
        """Copy other rows over these; columns and values may have more entries than `indptr` uses."""
        size = int(indptr[-1])
        self._make_room(size, 0)
        self.indptr = indptr
        self._indices[:size], self._values[:size] = indices[:size], values[:size]

    def merge(self, late: "_Rows") -> None:
        """Add pairs that these rows don't contain."""
        self._make_room(self.nonzeros + late.nonzeros, self.nonzeros)
        merge_rows(self.indptr, self._indices, self._values, *late.arrays())

    def _make_room(self, needed: int, size: int) -> None:
        if needed > len(self._indices):
            indices, values = (
                self._empty(2 * needed, np.int32),
                self._empty((2 * needed, len(LEVELS)), np.float64),
            )
            indices[:size], values[:size] = self._indices[:size], self._values[:size]
            self._indices, self._values = indices, values


class GramBuilder:
    """Builder that sums G over parts of W, such as views; its memory grows only with the size of G.

    If G is in files, memory holds only the pages that one part changes. Entries are summed in float64 in the
    order of the pixels, so results depend neither on the division of pixels into parts nor on the number of
    threads. A part shows about 10 % of the Gaussians of a large scene, so sums of known pairs are updated in
    place. Only late pairs, which were added since the last merge, are rewritten for each part.
    """

    def __init__(self, num_gaussians: int, threads: int, arrays: Scratch) -> None:
        self._arrays = arrays
        edges = np.linspace(0, num_gaussians, BLOCKS + 1).astype(np.int64).tolist()
        self._ranges = list(pairwise(edges))
        self._threads = max(1, threads)
        self._cells = np.zeros(0, np.uint64)
        self._rows = [_Rows(end - begin, arrays) for begin, end in self._ranges]
        self._late = [_Rows(end - begin, arrays) for begin, end in self._ranges]
        self._idle: SimpleQueue[tuple[np.ndarray, ...]] = SimpleQueue()  # buffers of each thread
        for _ in range(self._threads):
            number, fresh = np.zeros(num_gaussians, np.int32), np.empty(num_gaussians, np.int32)
            sums = np.empty((num_gaussians + 1) * SUMS)
            self._idle.put((number, sums, fresh, np.empty(1024, np.int32), np.empty((1024, len(LEVELS)))))

    @property
    def nonzeros(self) -> int:
        return sum(rows.nonzeros for rows in (*self._rows, *self._late))

    def add(self, part: StackedWeights) -> None:
        """Add W' diag(valid) W of further pixels; the columns of W must be sorted within rows."""
        weights = part.weights
        arrays = (weights.indptr, weights.indices, weights.data, part.valid)
        columns = self._columns(weights)

        def grow(block: int) -> None:
            begin, end = self._ranges[block]
            if columns[0][begin] == columns[0][end]:
                return
            rows, late, indptr = self._rows[block], self._late[block], np.zeros(end - begin + 1, np.int64)
            number, sums, fresh, *buffers = self._idle.get()
            pairs = rows.arrays(), late.arrays(), number
            try:
                buffers = add_to_block(begin, end, arrays, columns, *pairs, sums, fresh, indptr, *buffers)
                late.replace(indptr, *buffers)
            finally:  # after an error, such as a full disk, other blocks must not wait for these buffers
                self._idle.put((number, sums, fresh, *buffers))
            if MERGE_AT * late.nonzeros > rows.nonzeros:
                self._merged(block)

        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(grow, range(BLOCKS)))
        self._arrays.release()

    def _merged(self, number: int) -> _Rows:
        """Merge the late pairs of a block, and return all its pairs."""
        rows, late = self._rows[number], self._late[number]
        if late.nonzeros:
            rows.merge(late)
            self._late[number] = _Rows(len(rows.indptr) - 1, self._arrays)
        return rows

    def _columns(self, weights: sp.csr_matrix) -> tuple[np.ndarray, np.ndarray]:
        """Return the start of each Gaussian's list, and the lists of the pixel and place of each weight in W.

        A place is where the upper triangle's columns begin in the pixel's row of W. The lists are reused
        for the next part, because allocating memory takes longer than filling it.
        """
        if len(self._cells) < weights.nnz:
            self._cells = np.empty(weights.nnz * 9 // 8, np.uint64)
        begins = np.zeros(weights.shape[1] + 1, np.int64)
        transpose(weights.indptr, weights.indices, begins, self._cells)
        return begins, self._cells

    def state(self) -> dict[str, np.ndarray]:
        return {
            f"{name}_{number}": array
            for number in range(BLOCKS)
            for name, array in zip(ROWS, self._merged(number).arrays(), strict=True)
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        for number, rows in enumerate(self._rows):
            rows.replace(*(state[f"{name}_{number}"] for name in ROWS))

    def finish(self) -> Gram:
        """Return G of all added parts, and empty the builder."""
        indptr = np.zeros(self._ranges[-1][1] + 1, np.int64)
        indices = self._arrays.empty(self.nonzeros, np.int32)
        values = self._arrays.empty((len(indices), len(LEVELS)), np.float32)
        done = 0
        for number, (begin, end) in enumerate(self._ranges):
            some_indptr, some_indices, some_values = self._merged(number).arrays()
            self._rows[number] = _Rows(0, self._arrays)
            indptr[begin + 1 : end + 1] = some_indptr[1:] + done
            indices[done : done + len(some_indices)] = some_indices
            values[done : done + len(some_indices)] = some_values
            done += len(some_indices)
        return Gram(indptr, indices, values)


class QuadraticBuilder:
    """Builder of G or W, part by part; the matrix with fewer non-zeros is kept.

    A product reads each non-zero of G or W equally often. W is dropped and G is kept as soon as W has more
    than `MAX_WEIGHTS` non-zeros, or more than `CLEARLY_MORE` times those of G so far. G is dropped as soon as
    it has more than W will have if the remaining parts have as many as the parts so far. `keep` is "auto", or
    "gram" or "weights" to force G or W. Both are in `arrays`.
    """

    def __init__(self, num_gaussians: int, keep: str, parts: int, threads: int, arrays: Scratch) -> None:
        self._arrays = arrays
        self._num_gaussians, self._num_parts, self._added = num_gaussians, parts, 0
        self._gram = None if keep == "weights" else GramBuilder(num_gaussians, threads, arrays)
        self._keeps_weights = keep != "gram"
        self._may_drop = keep == "auto"
        self._parts: list[StackedWeights] = []
        self.weights_nonzeros = 0

    def add(self, part: StackedWeights) -> None:
        self.weights_nonzeros += part.nonzeros
        if self._keeps_weights:
            # copied, because a part shares the memory of all weights of its view, which may be much larger
            self._parts.append(stack_weights([part], self._arrays))
        self._added += 1
        if self._gram is None:
            return
        self._gram.add(part)
        if self._may_drop and self._keeps_weights:
            expected = self.weights_nonzeros / self._added * self._num_parts
            if self.weights_nonzeros > min(MAX_WEIGHTS, CLEARLY_MORE * self._gram.nonzeros):
                self._parts, self._keeps_weights = [], False
            elif expected < min(MAX_WEIGHTS, self._gram.nonzeros):
                self._gram = None

    def state(self) -> dict[str, np.ndarray]:
        counts = self.weights_nonzeros, self._keeps_weights, self._added, self._gram is not None
        out = {"counts": np.array(counts, np.int64)}
        if self._gram is not None:
            out |= self._gram.state()
        if self._parts:
            self._parts = [stacked := stack_weights(self._parts, self._arrays)]
            out |= {"valid": stacked.valid, "data": stacked.weights.data}
            out |= {"columns": stacked.weights.indices, "starts": stacked.weights.indptr}
        return out

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from `state`; the result is byte-identical to that of an uninterrupted pass."""
        self.weights_nonzeros, keeps_weights, self._added, has_gram = state["counts"].tolist()
        self._keeps_weights = bool(keeps_weights)
        if self._gram is not None and has_gram:
            self._gram.restore(state)
        else:
            self._gram = None
        if "valid" in state:
            shape = (len(state["valid"]), self._num_gaussians)
            matrix = sp.csr_matrix((state["data"], state["columns"], state["starts"]), shape=shape)
            self._parts = [StackedWeights(matrix, state["valid"])]

    def finish(self) -> Quadratic:
        if self._gram is None or (self._keeps_weights and self.weights_nonzeros < self._gram.nonzeros):
            return stack_weights(self._parts, self._arrays)
        return self._gram.finish()


class QuadraticCheckpoint:
    """Checkpoint of the sums, stored during a long pass; `keys` are digests of each view's contributions."""

    def __init__(self, folder: Path, keys: list[str], keep: str) -> None:
        self._keys = keys
        digest = sha256_of_json({"views": keys, "keep": keep, "max": MAX_WEIGHTS})
        self._folder = Path(folder) / digest
        self._last = time.monotonic()

    def resume(self, builder: QuadraticBuilder) -> int:
        """Restore the builder, and return the number of views it contains (0 without a checkpoint).

        An incomplete checkpoint, for example after the cache was pruned, is deleted.
        """
        if not (self._folder / INDEX).is_file():
            return 0
        try:
            index = read_index(self._folder)
            state = {name: read_npy(sealed(self._folder, f"{name}.npy")) for name in index["arrays"]}
        except ArtifactError as error:
            logger.warning("discarding an incomplete checkpoint of the contributions: %s", error)
            self.forget()
            return 0
        builder.restore(state)
        return int(index["summed"])

    def offer(self, builder: QuadraticBuilder, summed: int) -> None:
        """Write a checkpoint if the last one is old enough and some views are not yet summed."""
        if summed == len(self._keys) or time.monotonic() - self._last < CHECKPOINT_SECONDS:
            return
        state = builder.state()
        with atomic_folder(self._folder) as folder:
            for name, array in state.items():
                np.save(folder / f"{name}.npy", array)
            write_index(folder, {}, summed=summed, arrays=sorted(state))
        self._last = time.monotonic()

    def forget(self) -> None:
        delete(self._folder, DIGEST)


def stack_weights(parts: list[StackedWeights], arrays: Scratch) -> StackedWeights:
    """Join copies of parts, which are taken from the list one by one, so that memory holds W only once."""
    sizes, pixels = [part.nonzeros for part in parts], [len(part.valid) for part in parts]
    data, indices = (arrays.empty(sum(sizes), dtype) for dtype in (np.float32, np.int32))
    indptr, valid = np.zeros(sum(pixels) + 1, np.int64), np.empty((sum(pixels), len(LEVELS)), bool)
    at, row, columns = 0, 0, parts[0].num_gaussians
    for size, height in zip(sizes, pixels, strict=True):
        part = parts.pop(0)
        data[at : at + size], indices[at : at + size] = part.weights.data, part.weights.indices
        indptr[row + 1 : row + height + 1] = part.weights.indptr[1:] + at
        valid[row : row + height] = part.valid
        at, row = at + size, row + height
    return StackedWeights(sp.csr_matrix((data, indices, indptr), shape=(row, columns), copy=False), valid)
