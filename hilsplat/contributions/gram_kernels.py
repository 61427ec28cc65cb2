"""Compiled loops that sum G from weights; `quadratic_builder.GramBuilder` calls them."""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from hilsplat.base.compiled import compiled

SUMS = 4
"""Numbers of a pair of Gaussians while they are summed: one a level, and one for a vector of four."""


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
def _add_products(typingctx, sums, at, whole, part, subpart, value):
    """Add three numbers times `value` to the sums from `at` on, as one vector; nothing is fused."""

    def codegen(context, builder, sig, args):
        number, lane = ir.DoubleType(), ir.IntType(32)
        four = ir.VectorType(number, SUMS)
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        place = builder.bitcast(builder.gep(data, [args[1]]), four.as_pointer())
        weights, values = (
            ir.Constant(four, [ir.Constant(number, 0.0)] * SUMS),
            ir.Constant(four, ir.Undefined),
        )
        for index, each in enumerate(args[2:5]):
            weights = builder.insert_element(weights, each, ir.Constant(lane, index))
        for index in range(SUMS):
            values = builder.insert_element(values, args[5], ir.Constant(lane, index))
        grown = builder.fadd(builder.load(place, align=8), builder.fmul(weights, values))
        builder.store(grown, place, align=8)
        return context.get_dummy_value()

    return types.void(sums, types.intp, *[types.float64] * 4), codegen


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
    levels,
):
    """Rows begin..end of G: old values plus the new pixels; columns sorted."""
    num = len(begins) - 1
    seen = np.full(num, -1, np.int64)
    sums = np.zeros(num * SUMS, np.float64)
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
                sums[j * SUMS + level] = old_values[k, level]
        known = count
        for t in range(begins[i], begins[i + 1]):
            p = pixels[t]
            weight = np.float64(data[places[t]])
            whole = weight if valid[p, 0] else 0.0
            part = weight if valid[p, 1] else 0.0
            subpart = weight if valid[p, 2] else 0.0
            for k in range(np.uint64(places[t]), np.uint64(indptr[p + 1])):
                j = np.uint64(indices[k])  # unsigned: no look for negative indices
                at = np.int64(j) * SUMS
                if seen[j] != i:
                    seen[j] = i
                    sums[at : at + SUMS] = 0
                    found[count] = np.int32(j)
                    count += 1
                _add_products(sums, at, whole, part, subpart, np.float64(data[k]))
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
                out_values[done + place, level] = sums[found[place] * SUMS + level]
        done += count
        out_indptr[i - begin + 1] = done
    return out_indptr, out_indices[:done].copy(), out_values[:done].copy()
