"""Sum the quadratic form of frozen geometry view by view, in bounded memory, and choose G or W."""

import logging
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import scipy.sparse as sp

from hilsplat.base.artifacts import INDEX, atomic_folder, read_index, read_npy, sha256_of_json, write_index
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import LEVELS
from hilsplat.contributions.gram_kernels import SUMS, add_to_block, enlarged, merge_rows, transpose
from hilsplat.contributions.quadratic import Gram, Quadratic, StackedWeights

logger = logging.getLogger(__name__)

BLOCKS = 64
"""G is built in this many blocks of rows, one per thread at a time; the result does not depend on it. A block
of Gaussians that a part does not show stays untouched, which a Morton order makes frequent."""

MERGE_AT = 8
"""Late pairs of a block are merged with its rows when there is more than one to so many."""

CHUNK_WEIGHTS = 2**25
"""Non-zeros of W to gather before adding them to G; gathering and adding takes 0.6 GiB."""

LARGE_PART = 2**23
"""A part with so many non-zeros is added to G at once: the copy would take memory, and gain little."""

MAX_WEIGHTS = 2**28
"""W of all views is held in memory up to this many non-zeros, 2 GiB."""

CLEARLY_MORE = 2
"""W is dropped once it has this many times the non-zeros of G: more views add to W as before, less to G."""

CHECKPOINT_SECONDS = 300.0
"""Time between checkpoints of a long pass; short passes write none."""


class _Rows:
    """Some rows of G, in memory that is used again: a page costs time and memory once it is written to."""

    def __init__(self, rows: int) -> None:
        self.indptr = np.zeros(rows + 1, np.int64)
        self._indices, self._values = np.empty(0, np.int32), np.empty((0, len(LEVELS)))

    @property
    def nonzeros(self) -> int:
        """Pairs of Gaussians."""
        return int(self.indptr[-1])

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row starts, columns, values."""
        return self.indptr, self._indices[: self.nonzeros], self._values[: self.nonzeros]

    def replace(self, indptr: np.ndarray, indices: np.ndarray, values: np.ndarray) -> None:
        """Copy other rows over these; columns and values may have more room than `indptr` fills."""
        kept = int(indptr[-1])
        self._make_room(kept, 0)
        self.indptr = indptr
        self._indices[:kept], self._values[:kept] = indices[:kept], values[:kept]

    def merge(self, late: "_Rows") -> None:
        """Add pairs that are in none of these rows."""
        self._make_room(self.nonzeros + late.nonzeros, self.nonzeros)
        merge_rows(self.indptr, self._indices, self._values, *late.arrays())

    def _make_room(self, needed: int, kept: int) -> None:
        if needed > len(self._indices):
            self._indices, self._values = enlarged(self._indices, self._values, kept, 2 * needed)


class _Block:
    """Rows of G, and apart from them the few pairs that came late.

    A part shows a tenth of the Gaussians of a large scene. Sums of known pairs change in place, and the late
    ones alone are written anew, until there are enough of them to merge.
    """

    def __init__(self, rows: int) -> None:
        self.rows, self.late = _Rows(rows), _Rows(rows)

    @property
    def nonzeros(self) -> int:
        """Pairs of Gaussians."""
        return self.rows.nonzeros + self.late.nonzeros

    def replace_late(self, indptr: np.ndarray, indices: np.ndarray, values: np.ndarray) -> None:
        """Replace the late pairs, and merge them if they are many."""
        self.late.replace(indptr, indices, values)
        if MERGE_AT * self.late.nonzeros > self.rows.nonzeros:
            self.merged()

    def merged(self) -> _Rows:
        """All pairs."""
        if self.late.nonzeros:
            self.rows.merge(self.late)
            self.late = _Rows(len(self.rows.indptr) - 1)
        return self.rows


class _Scratch:
    """What one thread needs to add to a block."""

    def __init__(self, num_gaussians: int) -> None:
        self.sums = np.zeros(num_gaussians * SUMS)
        self.fresh = np.empty(num_gaussians, np.int32)
        self.indices, self.values = np.empty(1024, np.int32), np.empty((1024, len(LEVELS)))


class GramBuilder:
    """Sums G over parts of W, such as one view's after another; memory grows with G alone.

    Entries are summed in float64 in the order of the pixels, so the bytes depend neither on how the pixels
    were divided into parts nor on the number of threads.

    Args:
        num_gaussians: N.
        threads: number of threads that share the blocks of rows.
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
        """Pairs of Gaussians so far."""
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
        """Find each Gaussian's weights: start of its list, and lists of pixels and of places in W.

        From such a place on, the pixel's row of W holds the columns of the upper triangle. The lists are
        reused for the next part: allocating memory takes longer than filling it.
        """
        dtype = np.int32 if weights.nnz < 2**31 else np.int64
        if len(self._places) < weights.nnz or self._places.dtype != dtype:
            self._pixels = np.empty(weights.nnz * 9 // 8, np.int32)
            self._places = np.empty(len(self._pixels), dtype)
        begins = np.zeros(weights.shape[1] + 1, np.int64)
        transpose(weights.indptr, weights.indices, begins, self._pixels, self._places)
        return begins, self._pixels, self._places

    def state(self) -> dict[str, np.ndarray]:
        """Everything summed so far, as arrays."""
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
        """G of everything added; the builder is empty afterwards."""
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


class _Waiting:
    """Parts of W, one below the other, in memory that is used again: fresh memory takes longer to fill."""

    def __init__(self, num_gaussians: int) -> None:
        self._num_gaussians = num_gaussians
        self._indices, self._data = np.empty(0, np.int32), np.empty(0, np.float32)
        self._clear()

    def _clear(self) -> None:
        self.nonzeros = 0
        self._indptr = [np.zeros(1, np.int64)]
        self._valid = [np.zeros((0, len(LEVELS)), np.bool_)]

    def append(self, part: StackedWeights) -> None:
        """Copy a part below the others."""
        before, after = self.nonzeros, self.nonzeros + part.nonzeros
        if after > len(self._data):
            room = max(after, CHUNK_WEIGHTS * 9 // 8)
            self._indices, self._data = (_enlarged(old, before, room) for old in (self._indices, self._data))
        self._indices[before:after] = part.weights.indices
        self._data[before:after] = part.weights.data
        self._indptr.append(part.weights.indptr[1:].astype(np.int64) + before)
        self._valid.append(part.valid)
        self.nonzeros = after

    def held(self) -> StackedWeights:
        """All that waits, until something is appended."""
        indptr = np.concatenate(self._indptr)
        arrays = (self._data[: self.nonzeros], self._indices[: self.nonzeros], indptr)
        matrix = sp.csr_matrix(arrays, shape=(len(indptr) - 1, self._num_gaussians), copy=False)
        return StackedWeights(matrix, np.concatenate(self._valid))

    def take(self) -> StackedWeights:
        """The same; then nothing waits any more."""
        held = self.held()
        self._clear()
        return held


def _enlarged(array: np.ndarray, kept: int, room: int) -> np.ndarray:
    """Room for more entries, with the first `kept` of an array."""
    larger = np.empty(room, array.dtype)
    larger[:kept] = array[:kept]
    return larger


class QuadraticBuilder:
    """Collects W part by part and keeps whichever of G and W has fewer non-zeros.

    A product reads each non-zero of either equally often. W is dropped, and G kept, as soon as W has more
    than `MAX_WEIGHTS` non-zeros, or `CLEARLY_MORE` times those of G so far.

    Args:
        num_gaussians: N.
        keep: "auto", or "gram" or "weights" to force one.
        threads: number of threads that build G.
    """

    def __init__(self, num_gaussians: int, keep: str, threads: int) -> None:
        self._num_gaussians = num_gaussians
        self._gram = None if keep == "weights" else GramBuilder(num_gaussians, threads)
        self._keeps_weights = keep != "gram"
        self._may_drop = keep == "auto"
        self._parts: list[StackedWeights] = []
        self._waiting = _Waiting(num_gaussians)
        self.weights_nonzeros = 0

    def add(self, part: StackedWeights) -> None:
        """Add the labelled pixels of a view."""
        self.weights_nonzeros += part.nonzeros
        if self._keeps_weights:
            self._parts.append(part)
        most = MAX_WEIGHTS
        if self._gram is not None:
            is_large = part.nonzeros >= LARGE_PART
            if not is_large:
                self._waiting.append(part)
            if is_large or self._waiting.nonzeros >= CHUNK_WEIGHTS:
                self._add_waiting(self._gram)
                if is_large:
                    self._gram.add(part)
                most = min(most, CLEARLY_MORE * self._gram.nonzeros)
        if self._may_drop and self.weights_nonzeros > most:
            self._parts, self._keeps_weights = [], False

    def _add_waiting(self, gram: GramBuilder) -> None:
        if self._waiting.nonzeros:
            gram.add(self._waiting.take())

    def state(self) -> dict[str, np.ndarray]:
        """Everything added so far, as arrays."""
        out = {"nonzeros": np.array([self.weights_nonzeros, self._keeps_weights], np.int64)}
        if self._gram is not None:
            out |= {f"gram_{name}": array for name, array in self._gram.state().items()}
        held = {"parts": stack_weights(self._parts)} if self._parts else {}
        if self._waiting.nonzeros:
            held["waiting"] = self._waiting.held()
        for name, stacked in held.items():
            out[f"{name}_valid"] = stacked.valid
            for what in ("data", "indices", "indptr"):
                out[f"{name}_{what}"] = getattr(stacked.weights, what)
        return out

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from `state`; the result has the same bytes as without interruption."""
        self.weights_nonzeros, self._keeps_weights = int(state["nonzeros"][0]), bool(state["nonzeros"][1])
        if self._gram is not None:
            prefix = "gram_"
            self._gram.restore({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
        for name in ("parts", "waiting"):
            if f"{name}_valid" not in state:
                continue
            arrays = tuple(state[f"{name}_{what}"] for what in ("data", "indices", "indptr"))
            shape = (len(arrays[2]) - 1, self._num_gaussians)
            part = StackedWeights(sp.csr_matrix(arrays, shape=shape), state[f"{name}_valid"])
            (self._parts if name == "parts" else self._waiting).append(part)

    def finish(self) -> Quadratic:
        """G or W of everything added."""
        if self._gram is None:
            return stack_weights(self._parts)
        self._add_waiting(self._gram)
        if self._keeps_weights and self.weights_nonzeros < self._gram.nonzeros:
            return stack_weights(self._parts)
        return self._gram.finish()


class QuadraticCheckpoint:
    """The sums so far, kept on disk while a long pass runs.

    Args:
        folder: holds checkpoints.
        keys: digests of what each view contributes, in order.
        keep: as in `QuadraticBuilder`.
    """

    def __init__(self, folder: Path, keys: list[str], keep: str) -> None:
        self._keys = keys
        digest = sha256_of_json({"views": keys, "keep": keep, "max": MAX_WEIGHTS, "chunk": CHUNK_WEIGHTS})
        self._folder = Path(folder) / digest
        self._last = time.monotonic()

    def resume(self, builder: QuadraticBuilder) -> int:
        """Restore the builder; returns the number of views it then holds, 0 without a checkpoint.

        A checkpoint that lacks a file, for instance after the cache was pruned, is deleted.
        """
        if not (self._folder / INDEX).is_file():
            return 0
        try:
            index = read_index(self._folder)
            state = {name: read_npy(self._folder / f"{name}.npy") for name in index["arrays"]}
        except ArtifactError as error:
            logger.warning("discarding an incomplete checkpoint of the contributions: %s", error)
            self.forget()
            return 0
        builder.restore(state)
        return int(index["summed"])

    def offer(self, builder: QuadraticBuilder, summed: int) -> None:
        """Write a checkpoint if the last one is old enough and views are left."""
        if summed == len(self._keys) or time.monotonic() - self._last < CHECKPOINT_SECONDS:
            return
        state = builder.state()
        with atomic_folder(self._folder) as folder:
            for name, array in state.items():
                np.save(folder / f"{name}.npy", array)
            write_index(folder, {}, summed=summed, arrays=sorted(state))
        self._last = time.monotonic()

    def forget(self) -> None:
        """Delete the checkpoint of a finished pass."""
        shutil.rmtree(self._folder, ignore_errors=True)


def stack_weights(parts: list[StackedWeights]) -> StackedWeights:
    """Stack parts, one below the other."""
    if len(parts) == 1:
        return parts[0]
    matrix = sp.vstack([part.weights for part in parts], format="csr")
    return StackedWeights(matrix, np.concatenate([part.valid for part in parts]))
