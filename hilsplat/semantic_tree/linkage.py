"""Pooled average linkage of the masks of one level across views.

Everything is sparse: only masks that share Gaussians can be joined, and the mutual visibility of two clusters
is summed over the views of their members. The run time grows with the number of pairs that share Gaussians.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int64

from hilsplat.semantic_tree.evidence import Evidence
from hilsplat.semantic_tree.kernels import add_neighbours, link

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
