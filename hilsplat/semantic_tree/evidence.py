"""Agreement of masks from different views on the Gaussians that both views see.

Everything is sparse: only masks that share Gaussians are compared.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float64, Int32

from hilsplat.base.compiled import compiled

ROWS_AT_A_TIME = 64
"""Number of masks in one task of a thread."""


@dataclass(frozen=True)
class Evidence:
    """Agreement of each pair of the M masks of a level on the Gaussians that both views see.

    Attributes:
        intersection: of pairs a < b from different views that share Gaussians.
        union: of the same pairs, in the same order of stored values.
        seen: size of each mask as each of the V views sees it: its full size in its own view, 0 in views
            that see too little of it. A pair that is not stored has intersection 0 and union
            `seen[a, view[b]] + seen[b, view[a]]`.
        view: view of each mask.
    """

    intersection: sp.csr_matrix
    union: sp.csr_matrix
    seen: Float64[np.ndarray, "M V"]
    view: Int32[np.ndarray, " M"]


def mask_evidence(
    shares: sp.csr_matrix,
    importance: Float[np.ndarray, " N"],
    visible: Bool[np.ndarray, "V N"],
    view: Int32[np.ndarray, " M"],
    min_covisible: float,
    threads: int = 1,
) -> Evidence:
    """Compute the soft intersection and union of each pair of masks, on the Gaussians that both views see.

    Let s be the share of a Gaussian's visible weight inside a mask, and w its importance. The intersection of
    a and b is the sum of w s_a s_b. The size of a as seen from the view of b is the sum of w s_a^2 over the
    Gaussians visible there (Tanimoto). Fitted Gaussians reach across borders and have shares between 0 and 1.
    With squares, the IoU of a region with itself stays 1; with the sum of w s_a as the size it would shrink
    (shares of 0.3 give 0.18).

    Two masks of one view are different things, so they are evidence against a link (intersection 0, union
    both full sizes). Masks that share Gaussians are no evidence if each view sees less than `min_covisible`
    of the other mask. If masks share none, each counts if the other's view sees at least that share of it.

    Args:
        shares: s, one row per mask of a level; zero if the Gaussian is not visible in the mask's view.
        importance: w, such as the mean visible mass.
        visible: which Gaussians each view sees.
        view: view of each mask.
        min_covisible: pairs that see a smaller share of each other are dropped.
        threads: number of threads; the result does not depend on it.
    """

    def like(values: np.ndarray) -> sp.csr_matrix:
        return sp.csr_matrix((values, shares.indices, shares.indptr), shape=shares.shape, copy=False)

    share = shares.data.astype(np.float64)
    weight = importance.astype(np.float64)[shares.indices]
    size = weight * np.square(share)
    products = (like(share), like(weight * share), like(size), visible, view, min_covisible)
    upper, seen = _evidence_by_loops(*products, threads)
    shape = (len(view), len(view))
    intersection, union = (sp.csr_matrix((values, *upper[:2]), shape=shape) for values in upper[2:])
    return Evidence(intersection, union, seen, view)


def _evidence_by_loops(
    shares: sp.csr_matrix,
    weighted: sp.csr_matrix,
    sizes: sp.csr_matrix,
    visible: Bool[np.ndarray, "V N"],
    view: Int32[np.ndarray, " M"],
    min_covisible: float,
    threads: int,
) -> tuple[tuple[np.ndarray, ...], Float64[np.ndarray, "M V"]]:
    """Return the pairs a < b that share Gaussians, and `Evidence.seen`.

    Args:
        shares: s.
        weighted: w s, stored in the same pattern.
        sizes: each Gaussian's contribution to a mask's size, stored in the same pattern.
        visible, view, min_covisible, threads: as in `mask_evidence`.

    Returns:
        (b, row starts, intersection, union) of the pairs, and the sizes.
    """
    num = shares.shape[0]
    seen_everywhere = np.zeros((num, len(visible)))
    flags = np.ascontiguousarray(visible.T).view(np.uint8)
    columns = shares.tocsc()
    rows = (shares.indptr, shares.indices)
    with ThreadPoolExecutor(max(1, threads)) as pool:
        ranges = list(pairwise([*range(0, num, ROWS_AT_A_TIME), num]))
        list(pool.map(lambda span: _seen_sizes(*span, *rows, sizes.data, flags, seen_everywhere), ranges))
        seen = _counted(seen_everywhere, view, min_covisible)
        column_arrays = (columns.indptr, columns.indices, columns.data)
        parts = list(
            pool.map(
                lambda span: _shared_pairs(
                    *span, *rows, weighted.data, *column_arrays, view, seen, seen_everywhere
                ),
                ranges,
            )
        )
    if not parts:
        return (np.zeros(0, np.int32), np.zeros(num + 1, np.int64), np.zeros(0), np.zeros(0)), seen
    indptr = np.concatenate(([0], np.cumsum(np.concatenate([np.diff(part[0]) for part in parts]))))
    indices, intersection, union = (np.concatenate([part[k] for part in parts]) for k in (1, 2, 3))
    return (indices, indptr, intersection, union), seen


def _counted(
    seen_everywhere: Float64[np.ndarray, "M V"], view: Int32[np.ndarray, " M"], min_covisible: float
) -> Float64[np.ndarray, "M V"]:
    """Return the sizes that count as evidence: 0 where a view sees too little of a mask."""
    size = seen_everywhere[np.arange(len(view)), view]
    return np.where(seen_everywhere < min_covisible * size[:, None], 0.0, seen_everywhere)


@compiled
def _seen_sizes(begin, end, indptr, indices, sizes, visible, out):
    """Add up the size of each mask on the Gaussians that each view sees, into `out`."""
    for a in range(begin, end):
        for k in range(indptr[a], indptr[a + 1]):
            g = indices[k]
            for v in range(visible.shape[1]):
                out[a, v] += sizes[k] * visible[g, v]


@compiled
def _shared_pairs(
    begin, end, indptr, indices, weighted, col_indptr, col_rows, col_shares, view, seen, seen_everywhere
):
    """Return the pairs a < b that share Gaussians: row starts, b, intersection and union."""
    num = len(indptr) - 1
    touched_by = np.full(num, -1, np.int64)
    sums = np.zeros(num)
    found = np.empty(num, np.int32)
    out_indptr = np.zeros(end - begin + 1, np.int64)
    out = np.empty(1024, np.int32)
    out_intersection, out_union = np.empty(1024), np.empty(1024)
    done = 0
    for a in range(begin, end):
        count = 0
        for k in range(indptr[a], indptr[a + 1]):
            g = indices[k]
            for t in range(col_indptr[g + 1] - 1, col_indptr[g] - 1, -1):
                b = col_rows[t]
                if b <= a:
                    break
                if view[b] != view[a]:
                    if touched_by[b] != a:
                        touched_by[b] = a
                        sums[b] = 0.0
                        found[count] = b
                        count += 1
                    sums[b] += weighted[k] * col_shares[t]
        found[:count] = np.sort(found[:count])
        if done + count > len(out):
            room = 2 * (done + count)
            more, more_intersection, more_union = np.empty(room, np.int32), np.empty(room), np.empty(room)
            more[:done], more_intersection[:done] = out[:done], out_intersection[:done]
            more_union[:done] = out_union[:done]
            out, out_intersection, out_union = more, more_intersection, more_union
        for place in range(count):
            b = found[place]
            if seen[a, view[b]] == 0.0 and seen[b, view[a]] == 0.0:
                continue
            out[done] = b
            out_intersection[done] = sums[b]
            out_union[done] = seen_everywhere[a, view[b]] + seen_everywhere[b, view[a]] - sums[b]
            done += 1
        out_indptr[a - begin + 1] = done
    return out_indptr, out[:done].copy(), out_intersection[:done].copy(), out_union[:done].copy()
