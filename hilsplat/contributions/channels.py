"""Products of G and A with a float32 field, sixteen channels at a time, with the bytes of the plain loops.

For a loop over the few channels of a row, numba's vector code keeps sums in memory and checks in every pass
that arrays do not overlap. Here rows have a multiple of sixteen channels, in values of `lanes`, and the sums
of a row of G stay in registers: 62 ms instead of 168 ms at d = 16 and 6.7 million pairs of Gaussians.
"""

import numpy as np
from jaxtyping import Float32
from numba.extending import intrinsic

from hilsplat.base.compiled import compiled
from hilsplat.base.lanes import LANES, WIDTH, lanes, load, store

BLOCK = 2**15
"""Gaussians per pass of a product with A, so that their features stay in the processor's cache."""


def padded(rows: Float32[np.ndarray, "*rows D"]) -> Float32[np.ndarray, "*rows E"]:
    """Pad channels with zeros to a multiple of sixteen, and make rows contiguous."""
    missing = -rows.shape[-1] % WIDTH
    if missing:
        rows = np.concatenate([rows, np.zeros((*rows.shape[:-1], missing), np.float32)], axis=-1)
    return np.ascontiguousarray(rows)


@intrinsic
def plus(typingctx, total, scales, row):
    """Return total + scales * row; each product is rounded before it is added, as in the plain loop."""

    def codegen(context, builder, sig, args):
        return builder.fadd(args[0], builder.fmul(args[1], args[2]))  # without flags, so never fused

    return LANES(LANES, LANES, LANES), codegen


@compiled
def gram_product(begin, end, indptr, indices, values, features, width, out):
    """Compute `quadratic._gram_product` for flat features and `out`, with `width` padded channels per row."""
    row, origin = 3 * width, 3 * width * begin
    for i in range(begin, end):
        for c in range(0, width, WIDTH):
            here = i * row + c
            a, b, d = load(features, here), load(features, here + width), load(features, here + 2 * width)
            own = here - origin
            whole, part, subpart = load(out, own), load(out, own + width), load(out, own + 2 * width)
            for k in range(indptr[i], indptr[i + 1]):
                there = np.int64(indices[k]) * row + c
                u, v, w = lanes(values[k, 0]), lanes(values[k, 1]), lanes(values[k, 2])
                whole = plus(whole, u, load(features, there))
                part = plus(part, v, load(features, there + width))
                subpart = plus(subpart, w, load(features, there + 2 * width))
                if there != here:
                    other = there - origin
                    store(out, other, plus(load(out, other), u, a))
                    store(out, other + width, plus(load(out, other + width), v, b))
                    store(out, other + 2 * width, plus(load(out, other + 2 * width), w, d))
            store(out, own, whole)
            store(out, own + width, part)
            store(out, own + 2 * width, subpart)


@compiled
def mask_means(first, last, indptr, indices, data, level_index, features, width, out):
    """Compute `mask_operator._means` for flat features and `out`, with `width` channels per row."""
    num_gaussians = len(features) // (3 * width)
    at = indptr[first:last].copy()
    for begin in range(0, num_gaussians, BLOCK):
        for m in range(first, last):
            some = at[m - first]
            stop = at[m - first] = columns_below(begin + BLOCK, some, indptr[m + 1], indices)
            for c in range(0, width if some < stop else 0, WIDTH):
                place = level_index[m] * width + c
                total = load(out, m * width + c)
                for k in range(some, stop):
                    there = np.int64(indices[k]) * 3 * width + place
                    total = plus(total, lanes(data[k]), load(features, there))
                store(out, m * width + c, total)


@compiled
def mask_spread(begin, end, indptr, indices, data, level_index, values, width, out):
    """Compute `mask_operator._spread` for flat values and `out`, with `width` channels per row."""
    masks = len(level_index)
    at = np.empty(masks, np.int64)
    for m in range(masks):
        at[m] = indptr[m] + np.searchsorted(indices[indptr[m] : indptr[m + 1]], begin)
    for block in range(begin, end, BLOCK):
        for m in range(masks):
            some = at[m]
            stop = at[m] = columns_below(min(block + BLOCK, end), some, indptr[m + 1], indices)
            for c in range(0, width if some < stop else 0, WIDTH):
                place = level_index[m] * width + c
                value = load(values, m * width + c)
                for k in range(some, stop):
                    there = np.int64(indices[k]) * 3 * width + place
                    store(out, there, plus(load(out, there), lanes(data[k]), value))


@compiled
def columns_below(limit, begin, end, indices):
    """Return the end of the columns below `limit` in a row, begin..end of `indices`, which are sorted."""
    while begin < end and indices[begin] < limit:
        begin += 1
    return begin
