"""Sum the quadratic form of frozen geometry view by view, in bounded memory, and choose G or W."""

import logging
import shutil
import time
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from hilsplat.base.artifacts import (
    INDEX,
    atomic_folder,
    read_index,
    read_npy,
    sealed,
    sha256_of_json,
    write_index,
)
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import LEVELS
from hilsplat.contributions.gram_builder import GramBuilder
from hilsplat.contributions.quadratic import Quadratic, StackedWeights

logger = logging.getLogger(__name__)

CHUNK_WEIGHTS = 2**25
"""Non-zeros of W collected before they are added to G; collecting and adding takes 0.6 GiB."""

LARGE_PART = 2**23
"""Parts with this many non-zeros are added to G directly: collecting would copy them for little gain."""

MAX_WEIGHTS = 2**28
"""Non-zeros of all views' W up to which it is held in memory, 2 GiB."""

CLEARLY_MORE = 2
"""W is dropped once it has this many times the non-zeros of G: W grows linearly with the views, G less."""

CHECKPOINT_SECONDS = 300.0
"""Seconds between checkpoints of a long pass; short passes write none."""


class _Waiting:
    """Stacked parts of W in reused memory, because fresh memory takes longer to fill."""

    def __init__(self, num_gaussians: int) -> None:
        self._num_gaussians = num_gaussians
        room = CHUNK_WEIGHTS + LARGE_PART  # parts are smaller than the latter, and added beyond the former
        self._indices, self._data = np.empty(room, np.int32), np.empty(room, np.float32)
        self._clear()

    def _clear(self) -> None:
        self.nonzeros = 0
        self._indptr = [np.zeros(1, np.int64)]
        self._valid = [np.zeros((0, len(LEVELS)), np.bool_)]

    def append(self, part: StackedWeights) -> None:
        """Append a copy of a part."""
        before, after = self.nonzeros, self.nonzeros + part.nonzeros
        self._indices[before:after] = part.weights.indices
        self._data[before:after] = part.weights.data
        self._indptr.append(part.weights.indptr[1:].astype(np.int64) + before)
        self._valid.append(part.valid)
        self.nonzeros = after

    def held(self) -> StackedWeights:
        """Return all waiting parts; valid until the next part is appended."""
        indptr = np.concatenate(self._indptr)
        arrays = (self._data[: self.nonzeros], self._indices[: self.nonzeros], indptr)
        matrix = sp.csr_matrix(arrays, shape=(len(indptr) - 1, self._num_gaussians), copy=False)
        return StackedWeights(matrix, np.concatenate(self._valid))

    def take(self) -> StackedWeights:
        """Return all waiting parts, and remove them."""
        held = self.held()
        self._clear()
        return held


class QuadraticBuilder:
    """Builder of G or W, part by part; it keeps whichever has fewer non-zeros.

    A product reads each non-zero of either equally often. W is dropped and G is kept as soon as W has more
    than `MAX_WEIGHTS` non-zeros, or more than `CLEARLY_MORE` times those of G so far.

    Args:
        keep: "auto", or "gram" or "weights" to force one.
        threads: threads that build G.
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
            # copied, because a part shares the memory of all weights of its view, which may be much larger
            self._parts.append(StackedWeights(part.weights.copy(), part.valid))
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
        """Return everything added so far as arrays."""
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
        """Return G or W of everything added."""
        if self._gram is None:
            return stack_weights(self._parts)
        self._add_waiting(self._gram)
        if self._keeps_weights and self.weights_nonzeros < self._gram.nonzeros:
            return stack_weights(self._parts)
        return self._gram.finish()


class QuadraticCheckpoint:
    """Checkpoint of the sums, kept on disk during a long pass.

    Args:
        keys: digests of the contributions of each view, in order.
        keep: as in `QuadraticBuilder`.
    """

    def __init__(self, folder: Path, keys: list[str], keep: str) -> None:
        self._keys = keys
        digest = sha256_of_json({"views": keys, "keep": keep, "max": MAX_WEIGHTS, "chunk": CHUNK_WEIGHTS})
        self._folder = Path(folder) / digest
        self._last = time.monotonic()

    def resume(self, builder: QuadraticBuilder) -> int:
        """Restore the builder, and return the number of views it then contains, 0 without a checkpoint.

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
        """Write a checkpoint if the last one is old enough and views remain."""
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
    """Concatenate the rows of all parts."""
    if len(parts) == 1:
        return parts[0]
    matrix = sp.vstack([part.weights for part in parts], format="csr")
    return StackedWeights(matrix, np.concatenate([part.valid for part in parts]))
