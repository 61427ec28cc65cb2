"""Compiled loops that sum G from weights, for `quadratic_builder.GramBuilder`; `mask_kernels` shares two."""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from hilsplat.base.compiled import compiled

SUMS = 4
"""Numbers that are summed at once: three sums, and how many products were added; 0 of those mean new."""


@compiled
def transpose(indptr, indices, begins, pixels, places):
    """Start of each column's list, and the row and place of its values; `begins` must be zero."""
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

    Returns how often that was done before.
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
    """Copies of both with more room, and the first `kept` entries."""
    more_indices = np.empty(room, np.int32)
    more_values = np.empty((room, values.shape[1]), np.float64)
    more_indices[:kept], more_values[:kept] = indices[:kept], values[:kept]
    return more_indices, more_values


@compiled
def grown_block(
    begin,
    end,
    indptr,
    indices,
    data,
    valid,
    begins,
    pixels,
    places,
    old_indptr,
    old_indices,
    old_values,
    sums,
    fresh,
    out_indptr,
    out_indices,
    out_values,
):
    """Rows begin..end of G: old values plus the new pixels; columns sorted.

    `sums` must be zero, and is again; `fresh` has room for all columns. Returns the columns and the values,
    which lie in `out_indices` and `out_values` unless these were too small.
    """
    levels = old_values.shape[1]
    done = 0
    for i in range(begin, end):
        old, old_end = old_indptr[i - begin], old_indptr[i - begin + 1]
        for k in range(old, old_end):
            at = np.int64(old_indices[k]) * SUMS
            for level in range(levels):
                sums[at + level] = old_values[k, level]
            sums[at + levels] = 1
        count = 0
        for t in range(begins[i], begins[i + 1]):
            p = pixels[t]
            weight = np.float64(data[places[t]])
            whole = weight if valid[p, 0] else 0.0
            part = weight if valid[p, 1] else 0.0
            subpart = weight if valid[p, 2] else 0.0
            for k in range(np.uint64(places[t]), np.uint64(indptr[p + 1])):
                j = np.uint64(indices[k])  # unsigned: no look for negative indices
                if add_products(sums, np.int64(j) * SUMS, whole, part, subpart, np.float64(data[k])) == 0:
                    fresh[count] = np.int32(j)
                    count += 1
        if count:
            fresh[:count] = np.sort(fresh[:count])
        size = old_end - old + count
        if done + size > len(out_indices):
            out_indices, out_values = enlarged(out_indices, out_values, done, 2 * (done + size))
        new = 0
        for place in range(done, done + size):
            if new < count and (old == old_end or fresh[new] < old_indices[old]):
                column = fresh[new]
                new += 1
            else:
                column = old_indices[old]
                old += 1
            at = np.int64(column) * SUMS
            out_indices[place] = column
            for level in range(levels):
                out_values[place, level] = sums[at + level]
            sums[at : at + SUMS] = 0
        done += size
        out_indptr[i - begin + 1] = done
    return out_indices, out_values
