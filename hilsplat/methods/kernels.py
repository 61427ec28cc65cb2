"""Compiled loops of the methods."""

import numpy as np
import scipy.sparse as sp

from cpusplat.compiled import compiled
from cpusplat.lanes import load_quad, plus, prefetch, quad, signs_of_difference, store

# Loops over the entries of a sparse matrix process four channels of a Gaussian as one vector: with sixteen,
# codes with three channels would waste thirteen. Operations are neither fused nor reordered, so results are
# bit-identical to plain loops over the channels.
WIDTH = 4
# Rows have about 20 entries, and loops over a remainder take longer than products with a few zeros: rows are
# padded to a multiple of this number (`padded_rows`).
ENTRIES = np.uint64(4)
# The weights of a scene exceed the cache, and the rows of one level are scattered over them, so the processor
# doesn't load them early enough by itself.
ROWS_AHEAD = 8


def padded_rows(weights: sp.csr_matrix) -> sp.csr_matrix:
    """Return a matrix whose rows are padded to a multiple of `ENTRIES`; products with it are the same.

    The padding repeats the row's last column with weight 0. Both arrays are parts of one allocation: huge
    pages, which NumPy requests for 4 MiB or more, make a training step faster.
    """
    counts = np.diff(weights.indptr)
    padded = counts + -counts % int(ENTRIES)
    indptr = np.concatenate([[0], np.cumsum(padded)]).astype(weights.indptr.dtype)
    both = np.zeros(2 * indptr[-1], np.int32)
    indices, data = both[: indptr[-1]], both[indptr[-1] :].view(np.float32)
    places = np.arange(weights.nnz) + np.repeat(indptr[:-1] - weights.indptr[:-1], counts)
    last = np.maximum(weights.indptr[1:] - 1, 0)
    indices[:] = np.repeat(weights.indices[last], padded)
    indices[places], data[places] = weights.indices, weights.data
    return sp.csr_matrix((data, indices, indptr), shape=weights.shape)


@compiled
def rendered_gradient(
    indptr, indices, data, rows, labels, codes, share, attraction, offsets, wide, features, gradient
):
    """Write the features' gradient of a loss on rendered codes.

    At a labelled pixel with rendered code x and painted code c, the loss has the gradient
    `share` sign(x - c) + `attraction` x + offset.

    A row of weights is read once for its sum and, while still in the fastest cache, once for its gradient.
    Sums have the same order as products with the matrix and its transpose; one thread is used.

    Args:
        indptr, indices, data: weights (pixels x Gaussians), CSR, of `padded_rows`.
        rows: labelled pixels, in ascending order.
        labels: row of the code and the offset of each of these pixels.
        codes, offsets, features, gradient: float32, flat, `wide` numbers per row or Gaussian, with zeros
            after each code; without offsets, the last two terms are 0; `gradient` is written.
        share, attraction: float32.
        wide: multiple of `WIDTH`.
    """
    gradient[:] = 0
    for row in range(len(rows)):
        later = np.uint64(indptr[rows[min(row + ROWS_AHEAD, len(rows) - 1)]])
        for line in range(2):
            prefetch(indices, later + np.uint64(16 * line))
            prefetch(data, later + np.uint64(16 * line))
        # unsigned: skips negative-index checks
        begin, end = np.uint64(indptr[rows[row]]), np.uint64(indptr[rows[row] + 1])
        for c in range(0, wide, WIDTH):
            total = quad(np.float32(0))
            for k in range(begin, end, ENTRIES):
                for e in range(k, k + ENTRIES):
                    total = plus(total, quad(data[e]), load_quad(features, np.int64(indices[e]) * wide + c))
            code = np.int64(labels[row]) * wide + c
            pull = signs_of_difference(total, load_quad(codes, code), share)
            if len(offsets):
                pull = plus(pull, total, quad(attraction))
                pull = plus(pull, load_quad(offsets, code), quad(np.float32(1)))
            for k in range(begin, end, ENTRIES):
                for e in range(k, k + ENTRIES):
                    there = np.int64(indices[e]) * wide + c
                    store(gradient, there, plus(load_quad(gradient, there), quad(data[e]), pull))


@compiled
def weighted_sums(indptr, indices, data, wide, features, out):
    """Write the product of a sparse matrix, CSR, with features to `out`, as SciPy computes it but faster.

    The arrays are as in `rendered_gradient`, but rows may have any number of entries.
    """
    for row in range(len(indptr) - 1):
        for c in range(0, wide, WIDTH):
            total = quad(np.float32(0))
            for k in range(np.uint64(indptr[row]), np.uint64(indptr[row + 1])):
                total = plus(total, quad(data[k]), load_quad(features, np.int64(indices[k]) * wide + c))
            store(out, row * wide + c, total)


@compiled
def largest_entries(logits, chosen, shares):
    count = chosen.shape[1]
    for g in range(len(logits)):
        row, best = logits[g], chosen[g]
        held = 0
        for e in range(len(row)):
            at = held
            while at > 0 and row[e] > row[best[at - 1]]:
                at -= 1
            if at < count:
                held = min(held + 1, count)
                for k in range(held - 1, at, -1):
                    best[k] = best[k - 1]
                best[at] = e
        total = np.float32(0)
        for k in range(count):
            shares[g, k] = np.exp(row[best[k]] - row[best[0]])
            total += shares[g, k]
        for k in range(count):
            shares[g, k] /= total


@compiled
def share_gradients(indptr, indices, data, chosen, by_mixed, by_share):
    """Write the gradient of each Gaussian's kept shares."""
    for p in range(len(indptr) - 1):
        for j in range(indptr[p], indptr[p + 1]):
            g = indices[j]
            for k in range(chosen.shape[1]):
                by_share[g, k] += data[j] * by_mixed[p, chosen[g, k]]


@compiled
def joining_edges(num, edge_a, edge_b, first, second):
    """Return the edge that first connects each pair of pixels if edges are added in this order, or -1."""
    top = np.arange(num)  # union-find over pixels
    node = np.arange(num)  # dendrogram node of the root's component
    up = np.full(num + len(edge_a), -1, np.int64)
    for k in range(len(edge_a)):
        a, b = edge_a[k], edge_b[k]
        while top[a] != a:
            top[a] = top[top[a]]
            a = top[a]
        while top[b] != b:
            top[b] = top[top[b]]
            b = top[b]
        if a != b:
            up[node[a]] = num + k
            up[node[b]] = num + k
            top[b] = a
            node[a] = num + k
    out = np.full(len(first), -1, np.int64)
    for pair in range(len(first)):
        a, b = first[pair], second[pair]
        while a != b:  # parents have larger numbers
            if a < b:
                a = up[a]
            else:
                b = up[b]
            if a < 0 or b < 0:
                break
        if a == b and a >= num:
            out[pair] = a - num
    return out
