"""Agreement of masks from different views on the Gaussians that both views see, and linkage by agreement.

Everything is sparse: only masks of partner views that share Gaussians are compared and can be joined, and the
mutual visibility of two clusters is summed over the views of their members. The run time grows with the
number of pairs that share Gaussians.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float64, Int32, Int64

from cpusplat.threads import over_ranges
from hilsplat.semantic_tree.kernels import add_neighbours, link, seen_sizes, shared_pairs
from hilsplat.semantic_tree.view_pairs import ViewPairs


class MaskPairs(NamedTuple):
    """Pairs of masks.

    Attributes:
        firsts: first mask of each pair.
        seconds: second mask, which is greater.
        sums: of each pair, the intersection, the union minus both visible sizes (`Evidence.sizes`), and the
            IoU.
    """

    firsts: Int32[np.ndarray, " E"]
    seconds: Int32[np.ndarray, " E"]
    sums: Float64[np.ndarray, "E 3"]


@dataclass(frozen=True)
class Evidence:
    """Agreement of each pair of the M masks of a level on the Gaussians that both views see.

    Attributes:
        pairs: pairs of masks from different views, in ascending order, in blocks.
        size_indptr: where the visible sizes of each mask begin.
        size_views: partners of the mask's view, in ascending order.
        sizes: visible size of the mask in that view, 0 if the view sees too little of the mask.
        view: view of each mask.
    """

    pairs: tuple[MaskPairs, ...]
    size_indptr: Int64[np.ndarray, " M1"]
    size_views: Int32[np.ndarray, " F"]
    sizes: Float64[np.ndarray, " F"]
    view: Int32[np.ndarray, " M"]

    @property
    def num_pairs(self) -> int:
        """Number of pairs of masks."""
        return sum(len(block.firsts) for block in self.pairs)


def mask_evidence(
    shares: sp.csr_matrix,
    importance: Float[np.ndarray, " N"],
    visible: sp.csr_matrix,
    view: Int32[np.ndarray, " M"],
    pairs: ViewPairs,
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

    The result does not depend on the number of threads.

    Args:
        shares: float64, one row per mask of a level, view by view; zeros for Gaussians that are not visible
            in the mask's view.
        visible: (V, N) with a stored entry for each Gaussian visible in each view.
        view: ascending view of each mask.
        pairs: partners of each view.
    """
    num, num_views = len(view), visible.shape[0]
    starts = np.searchsorted(view, np.arange(num_views + 1))
    row_start = np.concatenate([[0], np.cumsum(np.diff(pairs.indptr)[view])])
    masks = starts, (shares.indptr, shares.indices, shares.data), importance.astype(np.float64)
    partners = (pairs.indptr, pairs.partners, pairs.mirror), row_start
    sizes, full = np.zeros(row_start[-1]), np.zeros(num)
    size_views = np.empty(row_start[-1], np.int32)
    gaussian_views = visible.indptr, visible.indices
    over_ranges(seen_sizes, num_views, threads, masks, gaussian_views, partners, sizes, size_views, full)
    least = min_covisible * full
    arguments = partners, sizes, least, pairs.min_iou
    blocks = over_ranges(shared_pairs, num_views, threads, masks, *arguments)
    sizes[sizes < np.repeat(least, np.diff(row_start))] = 0.0
    return Evidence(tuple(MaskPairs(*block) for block in blocks), row_start, size_views, sizes, view)


Linkage = tuple[Int64[np.ndarray, " M"], Float[np.ndarray, " K"]]
"""Cluster of each mask, numbered by first appearance, and each cluster's pooled IoU over its own pairs (0 for
one mask)."""


def pooled_linkage(evidence: Evidence, threshold: float) -> Callable[[], Linkage]:
    """Return a function that joins clusters while the best pair's pooled IoU is at least the threshold.

    The function can be called once, and doesn't keep the evidence's pairs.

    The IoU of two clusters is the sum of intersections divided by the sum of unions, over all pairs of a mask
    of one and a mask of the other. Pooling is reducible (joining never creates a better pair). On a tie, the
    pair with the lowest rows is joined.
    """
    num, starts, first = len(evidence.view), evidence.size_indptr, np.arange(len(evidence.view))
    linked = [np.flatnonzero(block.sums[:, 2] >= threshold) for block in evidence.pairs]
    of_linked = zip(evidence.pairs, linked, strict=True)
    columns = [(block.firsts[at], block.seconds[at], block.sums[at, 2]) for block, at in of_linked]
    firsts, seconds, iou = map(np.concatenate, zip(*columns, strict=True))
    best = np.argsort(-iou, kind="stable")
    pairs = firsts[best], seconds[best], iou[best]
    spare = np.empty(0, np.int32), np.empty(0)
    sizes = starts[:-1].copy(), starts[1:].copy(), evidence.size_views.copy(), evidence.sizes.copy(), *spare
    members = first.copy(), first + 1, evidence.view.copy(), np.ones(num), *spare
    counts = np.zeros(num, np.int64)
    for block in evidence.pairs:
        counts += np.bincount(block.firsts, minlength=num) + np.bincount(block.seconds, minlength=num)
    stop = np.cumsum(counts) - counts
    start = stop.copy()
    # NumPy's large arrays have huge pages, which compiled code's don't; short runs are read in random order.
    ids, values = np.empty(counts.sum(), np.int32), np.empty((counts.sum(), 2))
    for block in evidence.pairs:
        add_neighbours(*block, stop, ids, values)
    neighbours = [(start, stop, ids, values)]

    def linkage() -> Linkage:
        root, within = np.arange(num), np.zeros((2, num))
        link(pairs, neighbours.pop(), sizes, members, float(threshold), root, within)
        # A root is the lowest row of its cluster, so sorting roots numbers clusters by first appearance.
        tops, cluster = np.unique(root, return_inverse=True)
        quality = within[0, tops] / np.where(within[1, tops] > 0, within[1, tops], 1.0)
        return cluster.astype(np.int64), quality

    return linkage
