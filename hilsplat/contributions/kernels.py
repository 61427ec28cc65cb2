"""Compiled loops that sum weights of Gaussians over masks, and products of weights over pixels."""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from cpusplat.compiled import compiled
from cpusplat.lanes import prefetch, splat

SUMS = 4
"""Number of sums per pair that are stored as one vector: one per level, plus padding."""

AHEAD = 8
"""Weights of W are fetched into the cache this many pixels before they are needed."""

PLACE = np.uint64(2**32 - 1)
"""Bits of a cell (see `transpose`) that contain its place; the higher bits contain its row."""


@compiled
def summed_masks(first, last, runs, offsets, level_index, labels, half, indptr, indices, data, num_gaussians):
    """Sum weights over masks first..last, and count the summed pixels.

    Args:
        runs, offsets: as in `HierarchicalMasks`.
        labels: painted mask of each pixel and level, -1 for none.
        half: whether each pixel is in the random half.
        indptr, indices, data: W in CSR form, with positive weights; pixels without weights are ignored.

    Returns:
        counts (masks x 2) of painted pixels and of painted pixels in the half; row sizes; columns; sums over
        raw masks, painted pixels, and painted pixels in the half (entries x 3, float64, in pixel order).
    """
    sums, found = np.zeros(num_gaussians * SUMS), np.empty(num_gaussians, np.int32)
    counts = np.zeros((last - first, 2), np.int64)
    sizes = np.zeros(last - first, np.int64)
    columns, values = np.empty(1024, np.int32), np.empty((1024, 3))
    done = 0
    for m in range(first, last):
        count, pixel, level = 0, np.int64(0), level_index[m]
        for run in range(offsets[m], offsets[m + 1]):
            begin, pixel = pixel, pixel + np.int64(runs[run])
            if (run - offsets[m]) % 2 == 0:
                continue  # outside
            for p in range(begin, pixel):
                if indptr[p] == indptr[p + 1]:
                    continue
                painted = 1.0 if labels[p, level] == m else 0.0
                in_half = painted if half[p] else 0.0
                counts[m - first, 0] += painted > 0
                counts[m - first, 1] += in_half > 0
                for k in range(indptr[p], indptr[p + 1]):
                    j = np.uint64(indices[k])  # unsigned: skips the check for negative indices
                    at, weight = np.int64(j) * SUMS, np.float64(data[k])
                    if add_products(sums, at, 1.0, painted, in_half, weight) == 0:
                        found[count] = np.int32(j)
                        count += 1
        found[:count] = np.sort(found[:count])
        if done + count > len(columns):
            columns, values = enlarged(columns, values, done, 2 * (done + count))
        for k in range(count):
            at = np.int64(found[k]) * SUMS
            columns[done + k] = found[k]
            values[done + k] = sums[at : at + 3]
            sums[at : at + SUMS] = 0
        done += count
        sizes[m - first] = count
    return counts, sizes, columns[:done], values[:done]


@compiled
def move_to_front(rows, indptr, indices, data):
    """Move the weights of some rows of W to the front of its arrays, and return the number of weights."""
    done = np.uint64(0)  # unsigned: skips the check for negative indices
    for row in rows:
        for k in range(np.uint64(indptr[row]), np.uint64(indptr[row + 1])):
            indices[done], data[done] = indices[k], data[k]
            done += np.uint64(1)
    return done


@compiled
def transpose(indptr, indices, begins, cells):
    """Write each column's start to `begins`, and the cells of its values, row * 2**32 + place, to `cells`.

    `begins` must contain zeros. All integers are unsigned, which skips the checks for negative indices.
    """
    for k in range(np.uint64(indptr[-1])):
        begins[np.uint64(indices[k]) + np.uint64(1)] += 1
    begins[:] = np.cumsum(begins)
    filled = begins[:-1].astype(np.uint32)
    for p in range(len(indptr) - 1):
        for k in range(np.uint64(indptr[p]), np.uint64(indptr[p + 1])):
            j = np.uint64(indices[k])
            at = np.uint64(filled[j])
            cells[at] = (np.uint64(p) << np.uint64(32)) | k
            filled[j] = np.uint32(at + np.uint64(1))


@intrinsic
def add_products(typingctx, sums, at, whole, part, subpart, value):
    """Add `value` times three numbers to the sums at `at`, as one vector and without fused operations.

    Returns the previous value of the first sum.
    """

    def codegen(context, builder, sig, args):
        number, lane = ir.DoubleType(), ir.IntType(32)
        four = ir.VectorType(number, SUMS)
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        place = builder.bitcast(builder.gep(data, [args[1]]), four.as_pointer())
        weights = ir.Constant(four, [ir.Constant(number, 0.0)] * SUMS)
        for index, each in enumerate(args[2:5]):
            weights = builder.insert_element(weights, each, ir.Constant(lane, index))
        before = builder.load(place, align=8)
        products = builder.fmul(weights, splat(builder, args[5], SUMS))
        builder.store(builder.fadd(before, products), place, align=8)
        return builder.extract_element(before, ir.Constant(lane, 0))

    return types.float64(sums, types.intp, *[types.float64] * 4), codegen


@compiled
def enlarged(indices, values, kept, room):
    """Return larger copies of both arrays with their first `kept` entries."""
    more_indices = np.empty(room, np.int32)
    more_values = np.empty((room, values.shape[1]), np.float64)
    more_indices[:kept], more_values[:kept] = indices[:kept], values[:kept]
    return more_indices, more_values


@compiled
def add_to_block(
    begin, end, part, columns, rows, late, number, sums, fresh, out_indptr, out_indices, out_values
):
    """Add the pixels of a part to rows begin..end of G.

    Pairs in `rows` are summed in place; pairs in `late` and new pairs are written to the output. A row's
    pairs are numbered from 1, first those of `rows`, then of `late`, so its sums fit into the fastest cache.

    Args:
        part: row starts, columns and values of W, and whether each pixel has a mask at each level.
        columns: output of `transpose` for the part: starts and cells.
        rows, late: row starts, columns, and sums by level (E x 3); no pair is in both.
        number: an integer per Gaussian, zero before and after the call.
        sums: buffer for SUMS numbers per Gaussian and SUMS more.
        fresh: buffer for new columns, one number per Gaussian.
        out_indptr, out_indices, out_values: late pairs; columns are sorted within rows.

    Returns:
        `out_indices` and `out_values`, or larger copies if they were too small.
    """
    indptr, indices, data, valid = part
    begins, cells = columns
    row_indptr, row_indices, row_values = rows
    late_indptr, late_indices, late_values = late
    levels = row_values.shape[1]
    done = 0
    for i in range(begin, end):
        first, last = row_indptr[i - begin], row_indptr[i - begin + 1]
        old, old_end = late_indptr[i - begin], late_indptr[i - begin + 1]
        known, shown = last - first + old_end - old, begins[i] < begins[i + 1]
        count = known
        if shown:
            _number(first, last, row_indices, row_values, 0, number, sums)
            _number(old, old_end, late_indices, late_values, last - first, number, sums)
        for t in range(begins[i], begins[i + 1]):
            p, place = cells[t] >> np.uint64(32), cells[t] & PLACE
            ahead = np.int64(cells[min(t + AHEAD, len(cells) - 1)] & PLACE)
            prefetch(indices, ahead)
            prefetch(data, ahead)
            weight = np.float64(data[place])
            whole = weight if valid[p, 0] else 0.0
            part_weight = weight if valid[p, 1] else 0.0
            subpart = weight if valid[p, 2] else 0.0
            for k in range(place, np.uint64(indptr[p + 1])):
                j = np.uint64(indices[k])  # unsigned: skips the check for negative indices
                at = np.int64(number[j])
                if at == 0:
                    fresh[count - known] = np.int32(j)
                    count += 1
                    at = np.int64(count)
                    number[j] = np.int32(count)
                    sums[at * SUMS : at * SUMS + SUMS] = 0
                add_products(sums, at * SUMS, whole, part_weight, subpart, np.float64(data[k]))
        count -= known
        if count:
            fresh[:count] = np.sort(fresh[:count])
        size = old_end - old + count
        if done + size > len(out_indices):
            out_indices, out_values = enlarged(out_indices, out_values, done, 2 * (done + size))
        if shown:
            for k in range(first, last):
                number[row_indices[k]] = 0
                for level in range(levels):
                    row_values[k, level] = sums[(k - first + 1) * SUMS + level]
            new = 0
            for place in range(done, done + size):
                if new < count and (old == old_end or fresh[new] < late_indices[old]):
                    column = fresh[new]
                    new += 1
                else:
                    column = late_indices[old]
                    old += 1
                out_indices[place] = column
                for level in range(levels):
                    out_values[place, level] = sums[np.int64(number[column]) * SUMS + level]
                number[column] = 0
        else:
            out_indices[done : done + size] = late_indices[old:old_end]
            out_values[done : done + size] = late_values[old:old_end]
        done += size
        out_indptr[i - begin + 1] = done
    return out_indices, out_values


@compiled
def _number(first, last, indices, values, before, number, sums):
    """Number the pairs first..last from `before` + 1, and load their sums."""
    for k in range(first, last):
        at = before + k - first + 1
        number[indices[k]] = np.int32(at)
        for level in range(values.shape[1]):
            sums[at * SUMS + level] = values[k, level]


@compiled
def merge_rows(indptr, indices, values, late_indptr, late_indices, late_values):
    """Merge late pairs into the rows in place, from the end; `indices` and `values` must have enough room."""
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
