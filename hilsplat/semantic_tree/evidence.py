"""Agreement of masks from different views on the Gaussians that both views see.

Everything is sparse: only masks that share Gaussians are compared.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float64, Int32

from cpusplat.threads import over_edges
from hilsplat.semantic_tree.kernels import seen_sizes, shared_pairs

ROWS_AT_A_TIME = 64
"""Number of masks per thread task."""


@dataclass(frozen=True)
class Evidence:
    """Agreement of each pair of the M masks of a level on the Gaussians that both views see.

    Attributes:
        intersection: soft intersection of pairs a < b from different views that share Gaussians.
        union: soft union of the same pairs, in the same order.
        seen: visible size of each mask in each of the V views: the full size in the mask's own view, 0 in
            views that see too little of the mask. A pair that is not stored has intersection 0 and union
            `seen[a, view[b]] + seen[b, view[a]]`.
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
    Gaussians visible there (Tanimoto). Fitted Gaussians extend across borders and have shares between 0 and
    1. With squares, the IoU of a region with itself stays 1; with the sum of w s_a as the size, it would be
    smaller (shares of 0.3 give 0.18).

    Two masks of one view show different objects, so they are evidence against a link (intersection 0, union:
    both full sizes). Masks that share Gaussians are ignored if each view shows less than `min_covisible` of
    the other mask. Of masks that share none, each counts if the other view shows at least that share of it.

    `shares` has one row per mask of a level, and zeros for Gaussians not visible in the mask's view.
    The result does not depend on the number of threads.
    """
    num, share = len(view), shares.data.astype(np.float64)
    weight = importance.astype(np.float64)[shares.indices]
    sizes, weighted = weight * np.square(share), weight * share
    columns = sp.csr_matrix((share, shares.indices, shares.indptr), shape=shares.shape, copy=False).tocsc()
    rows, by_column = (shares.indptr, shares.indices), (columns.indptr, columns.indices, columns.data)
    flags = np.ascontiguousarray(visible.T).view(np.uint8)
    everywhere = np.zeros((num, len(visible)))  # size of each mask as seen from each view
    edges = [0, *range(ROWS_AT_A_TIME, num, ROWS_AT_A_TIME), num]
    over_edges(seen_sizes, edges, threads, *rows, sizes, flags, everywhere)
    full = everywhere[np.arange(num), view]
    seen = np.where(everywhere < min_covisible * full[:, None], 0.0, everywhere)
    pairs = (*rows, weighted, *by_column, view, seen, everywhere)
    parts = [list(arrays) for arrays in zip(*over_edges(shared_pairs, edges, threads, *pairs), strict=True)]
    # Each list is freed once it is concatenated, because two copies of all pairs would need much memory.
    counts, indices, inter, union = (np.concatenate(parts.pop(0)) for _ in range(4))
    indptr = np.concatenate(([0], np.cumsum(counts)))
    intersections, unions = (
        sp.csr_matrix((values, indices, indptr), shape=(num, num)) for values in (inter, union)
    )
    return Evidence(intersections, unions, seen, view)
