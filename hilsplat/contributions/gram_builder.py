"""Sum G over parts of W, in memory that grows only with G."""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from queue import SimpleQueue

import numpy as np
import scipy.sparse as sp
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from hilsplat.base.compiled import compiled
from hilsplat.base.levels import LEVELS
from hilsplat.contributions.quadratic import Gram, StackedWeights

BLOCKS = 64
"""G is built in this many blocks of rows, one per thread at a time; the result does not depend on it. Blocks
whose Gaussians a part does not show are skipped, which a Morton order makes frequent."""

MERGE_AT = 8
"""Late pairs of a block are merged with its rows once they exceed one in this many."""

SUMS = 4
"""Numbers that are summed together: three sums, and the number of products added, 0 for a new pair."""


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
        _merge_rows(self.indptr, self._indices, self._values, *late.arrays())

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
            own.indices, own.values = _add_to_block(begin, end, arrays, columns, *known, *scratch)
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
        _transpose(weights.indptr, weights.indices, begins, self._pixels, self._places)
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


@compiled
def _transpose(indptr, indices, begins, pixels, places):
    """Return each column's start, and the row and place of its values; `begins` must be zero."""
    for k in range(indptr[-1]):
        begins[indices[k] + 1] += 1
    begins[:] = np.cumsum(begins)
    filled = begins[:-1].copy()
    for p in range(len(indptr) - 1):
        for k in range(indptr[p], indptr[p + 1]):
            at = filled[indices[k]]
            pixels[at] = p
            places[at] = k
            filled[indices[k]] += 1


@intrinsic
def add_products(typingctx, sums, at, whole, part, subpart, value):
    """Add three numbers times `value`, and 1, to the sums from `at` on, as one vector; nothing is fused.

    Returns the number of previous additions.
    """

    def codegen(context, builder, sig, args):
        number, lane = ir.DoubleType(), ir.IntType(32)
        four = ir.VectorType(number, SUMS)
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        place = builder.bitcast(builder.gep(data, [args[1]]), four.as_pointer())
        weights = values = ir.Constant(four, [ir.Constant(number, 1.0)] * SUMS)
        for index, each in enumerate(args[2:5]):
            weights = builder.insert_element(weights, each, ir.Constant(lane, index))
            values = builder.insert_element(values, args[5], ir.Constant(lane, index))
        before = builder.load(place, align=8)
        builder.store(builder.fadd(before, builder.fmul(weights, values)), place, align=8)
        return builder.extract_element(before, ir.Constant(lane, SUMS - 1))

    return types.float64(sums, types.intp, *[types.float64] * 4), codegen


@compiled
def enlarged(indices, values, kept, room):
    """Return larger copies of both arrays with their first `kept` entries."""
    more_indices = np.empty(room, np.int32)
    more_values = np.empty((room, values.shape[1]), np.float64)
    more_indices[:kept], more_values[:kept] = indices[:kept], values[:kept]
    return more_indices, more_values


@compiled
def _load(first, last, indices, values, sums):
    """Load pairs of a row into the sums, and mark them as known."""
    levels = values.shape[1]
    for k in range(first, last):
        at = np.int64(indices[k]) * SUMS
        for level in range(levels):
            sums[at + level] = values[k, level]
        sums[at + levels] = 1


@compiled
def _add_to_block(begin, end, part, columns, rows, late, sums, fresh, out_indptr, out_indices, out_values):
    """Add the pixels of a part to rows begin..end of G.

    Pairs in `rows` are summed in place; pairs in `late` and new pairs are written to the output.

    Args:
        part: row starts, columns and values of W, and whether a pixel counts at each level.
        columns: output of `_transpose` for the part: starts, pixels and places.
        rows, late: row starts, columns, and sums by level (E x 3); no pair is in both.
        sums: zero before and after the call; SUMS for each Gaussian.
        fresh: buffer for all columns.
        out_indptr, out_indices, out_values: late pairs, with columns sorted within rows.

    Returns:
        `out_indices` and `out_values`, or larger copies if they were too small.
    """
    indptr, indices, data, valid = part
    begins, pixels, places = columns
    row_indptr, row_indices, row_values = rows
    late_indptr, late_indices, late_values = late
    levels = row_values.shape[1]
    done = 0
    for i in range(begin, end):
        first, last = row_indptr[i - begin], row_indptr[i - begin + 1]
        old, old_end = late_indptr[i - begin], late_indptr[i - begin + 1]
        count, shown = 0, begins[i] < begins[i + 1]
        if shown:
            _load(first, last, row_indices, row_values, sums)
            _load(old, old_end, late_indices, late_values, sums)
        for t in range(begins[i], begins[i + 1]):
            p = pixels[t]
            weight = np.float64(data[places[t]])
            whole = weight if valid[p, 0] else 0.0
            part_weight = weight if valid[p, 1] else 0.0
            subpart = weight if valid[p, 2] else 0.0
            for k in range(np.uint64(places[t]), np.uint64(indptr[p + 1])):
                j = np.uint64(indices[k])  # unsigned: skips the check for negative indices
                at, value = np.int64(j) * SUMS, np.float64(data[k])
                if add_products(sums, at, whole, part_weight, subpart, value) == 0:
                    fresh[count] = np.int32(j)
                    count += 1
        if count:
            fresh[:count] = np.sort(fresh[:count])
        size = old_end - old + count
        if done + size > len(out_indices):
            out_indices, out_values = enlarged(out_indices, out_values, done, 2 * (done + size))
        if shown:
            for k in range(first, last):
                at = np.int64(row_indices[k]) * SUMS
                for level in range(levels):
                    row_values[k, level] = sums[at + level]
                sums[at : at + SUMS] = 0
            new = 0
            for place in range(done, done + size):
                if new < count and (old == old_end or fresh[new] < late_indices[old]):
                    column = fresh[new]
                    new += 1
                else:
                    column = late_indices[old]
                    old += 1
                at = np.int64(column) * SUMS
                out_indices[place] = column
                for level in range(levels):
                    out_values[place, level] = sums[at + level]
                sums[at : at + SUMS] = 0
        else:
            out_indices[done : done + size] = late_indices[old:old_end]
            out_values[done : done + size] = late_values[old:old_end]
        done += size
        out_indptr[i - begin + 1] = done
    return out_indices, out_values


@compiled
def _merge_rows(indptr, indices, values, late_indptr, late_indices, late_values):
    """Merge late pairs into the rows, in place from the end; `indices` and `values` have room for all."""
    at = indptr[-1] + late_indptr[-1]
    for i in range(len(indptr) - 2, -1, -1):
        k, t = indptr[i + 1] - 1, late_indptr[i + 1] - 1
        if at == k + 1:
            break  # no late pair is left
        indptr[i + 1] = at
        while k >= indptr[i] or t >= late_indptr[i]:
            at -= 1
            if t < late_indptr[i] or (k >= indptr[i] and indices[k] > late_indices[t]):
                indices[at] = indices[k]
                values[at] = values[k]
                k -= 1
            else:
                indices[at] = late_indices[t]
                values[at] = late_values[t]
                t -= 1
