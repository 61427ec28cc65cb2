"""Pooled average linkage of the masks of one level across views.

Everything is sparse: only masks that share Gaussians can be joined, and the mutual visibility of two clusters
is summed over the views of their members. The run time grows with the number of pairs that share Gaussians.
"""

import numpy as np
from jaxtyping import Float, Int64

from cpusplat.compiled import compiled
from hilsplat.semantic_tree.evidence import Evidence

ROWS_OF_A_BLOCK = 256
"""Rows per block; the best score of each block is stored, so finding the best row requires few reads."""


def pooled_linkage(
    evidence: Evidence, threshold: float
) -> tuple[Int64[np.ndarray, " M"], Float[np.ndarray, " K"]]:
    """Join clusters while the best pair's pooled IoU is at least the threshold.

    The IoU of two clusters is the sum of intersections divided by the sum of unions, over all pairs of a mask
    of one and a mask of the other. Pooling is reducible (joining never creates a better pair), so one nearest
    neighbour per cluster suffices. On a tie, the pair with the lowest rows is joined.

    Returns:
        cluster of each mask, numbered by first appearance, and each cluster's pooled IoU over its
        own pairs (0 for a single mask).
    """
    num = len(evidence.view)
    pairs = evidence.intersection
    values = pairs.data, evidence.union.data
    pool = _neighbours(pairs.indptr, pairs.indices, *values, evidence.seen, evidence.view)
    within = np.zeros((2, num))
    root = np.arange(num)
    _link(*pool, evidence.seen.copy(), evidence.view, float(threshold), root, within)
    # A root is the lowest row of its cluster, so sorting roots numbers clusters by first appearance.
    tops, cluster = np.unique(root, return_inverse=True)
    quality = within[0, tops] / np.where(within[1, tops] > 0, within[1, tops], 1.0)
    return cluster.astype(np.int64), quality


@compiled
def _neighbours(indptr, indices, intersection, union, seen, view):
    """Return the initial pool of neighbours for `_link`, with 25 % spare room, and the bounds of each run."""
    num = len(view)
    start = np.zeros(num + 1, np.int64)
    for a in range(num):
        start[a + 1] += indptr[a + 1] - indptr[a]
        for k in range(indptr[a], indptr[a + 1]):
            start[indices[k] + 1] += 1
    start = np.cumsum(start)[:num]
    stop = start.copy()
    room = 2 * len(indices) + len(indices) // 2 + 1024
    neighbour = np.empty(room, np.int32)
    inter, extra = np.empty(room), np.empty(room)
    for a in range(num):  # rows in order, so that each run's neighbours are also in order
        for k in range(indptr[a], indptr[a + 1]):
            b = np.int64(indices[k])
            apart = seen[a, view[b]] + seen[b, view[a]]
            for own, other in ((a, b), (b, a)):
                at = stop[own]
                neighbour[at], inter[at], extra[at] = other, intersection[k], union[k] - apart
                stop[own] += 1
    return start, stop, neighbour, inter, extra


@compiled
def _merged_run(begin, end, first, neighbour, inter, extra, root, place_of, self_a, self_b):
    """Copy a run of neighbours to position `first`, and sum entries merged after it was written.

    Entries copied there from an earlier run of the cluster are summed too. Entries that refer to the
    cluster itself are omitted. Returns the end of the run and the two sums of the omitted entries.
    """
    own_inter, own_extra = 0.0, 0.0
    last = first
    for k in range(begin, end):
        c = root[neighbour[k]]
        value, more = inter[k], extra[k]
        if c in (self_a, self_b):
            own_inter += value
            own_extra += more
        elif place_of[c] < 0:
            place_of[c] = last
            neighbour[last], inter[last], extra[last] = c, value, more
            last += 1
        else:
            inter[place_of[c]] += value
            extra[place_of[c]] += more
    return last, own_inter, own_extra


@compiled
def _plus_sizes(total, i, j, seen, members, shown, shows):
    """For each view, add to `total` each cluster's size times the number of the other's members there."""
    num_views = seen.shape[1]
    at_i = at_j = 0
    while at_i < shows[i] or at_j < shows[j]:
        next_i = shown[i, at_i] if at_i < shows[i] else num_views
        next_j = shown[j, at_j] if at_j < shows[j] else num_views
        v = min(next_i, next_j)
        at_i += next_i == v
        at_j += next_j == v
        total += seen[i, v] * members[j, v] + seen[j, v] * members[i, v]
    return total


@compiled
def _best_neighbour(i, begin, end, neighbour, inter, extra, seen, members, shown, shows, place_of):
    """Return the neighbour with the best pooled IoU in a run of `_merged_run` (-1: none), and that IoU.

    On a tie, the lowest row is returned. The run's marks in `place_of` are cleared.
    """
    best, score = -1, -1.0
    for k in range(begin, end):
        j = neighbour[k]
        place_of[j] = -1
        union = _plus_sizes(extra[k], i, j, seen, members, shown, shows)
        if union > 0.0:
            pooled = inter[k] / union
            if pooled > score or (pooled == score and j < best):
                best, score = j, pooled
    return best, score


@compiled
def _compacted(needed, alive, start, stop, neighbour, inter, extra):
    """Move the runs of existing clusters to the front of the pool or to a larger pool; update their bounds.

    The new pool has room for `needed` more entries.
    """
    living = 0
    for i in range(len(alive)):
        if alive[i]:
            living += stop[i] - start[i]
    to_neighbour, to_inter, to_extra = neighbour, inter, extra
    if living + needed > len(neighbour):
        room = 2 * (living + needed)
        to_neighbour, to_inter, to_extra = np.empty(room, np.int32), np.empty(room), np.empty(room)
    used = 0
    for i in np.argsort(start):  # in pool order, so that no run overwrites one that has not been moved
        if alive[i]:
            begin, start[i] = start[i], used
            for k in range(begin, stop[i]):
                to_neighbour[used], to_inter[used], to_extra[used] = neighbour[k], inter[k], extra[k]
                used += 1
            stop[i] = used
    return to_neighbour, to_inter, to_extra, used


@compiled
def _set_score(i, value, score, block_best):
    """Set a row's score and update the best score of its block."""
    score[i] = value
    block = i // ROWS_OF_A_BLOCK
    best = -np.inf
    for row in range(block * ROWS_OF_A_BLOCK, min((block + 1) * ROWS_OF_A_BLOCK, len(score))):
        best = max(best, score[row])
    block_best[block] = best


@compiled
def _best_row(score, block_best):
    """Return the lowest row with the best score, or -1 if there are no rows."""
    block = np.argmax(block_best)
    for row in range(block * ROWS_OF_A_BLOCK, min((block + 1) * ROWS_OF_A_BLOCK, len(score))):
        if score[row] == block_best[block]:
            return row
    return -1


@compiled
def _link(start, stop, neighbour, inter, extra, seen, view, threshold, root, within):
    """Merge clusters in place; afterwards `root` is the lowest row of each mask's cluster.

    A pool stores the clusters' neighbours, one run per cluster: the neighbour, the sum of intersections
    (`inter`), and the sum of the differences between the unions of stored pairs and `seen` (`extra`, never
    positive, because sizes count the overlap of two masks twice). The union of two clusters is `extra` plus,
    over views, the size of each cluster in the view times the number of the other cluster's members there.
    Neighbours merged after a run was written are summed when it is next read. The run of a merged cluster is
    written at the end of the pool, which is compacted when full.
    """
    num, num_views = seen.shape
    used = stop[-1] if num else 0
    members = np.zeros((num, num_views))
    # Views of each cluster's members, in order, and the number of these views.
    shown, shows = np.empty((num, num_views), np.int32), np.ones(num, np.int32)
    for i in range(num):
        members[i, view[i]] = 1.0
        shown[i, 0] = view[i]
    alive = np.ones(num, np.bool_)
    best = np.full(num, -1, np.int64)
    # Number of merges of each cluster, and of its best neighbour when the neighbour was found. If the
    # neighbour has merged since, the score is only an upper bound, because joining never creates a better
    # pair. A bound is recomputed only when it is the best score.
    merges, best_merges = np.zeros(num, np.int64), np.full(num, -1, np.int64)
    score = np.full(num, np.inf)
    block_best = np.full(num // ROWS_OF_A_BLOCK + 1, -np.inf)
    block_best[: -(-num // ROWS_OF_A_BLOCK)] = np.inf
    place_of = np.full(num, -1, np.int64)
    while True:
        top = _best_row(score, block_best)
        if top < 0 or score[top] < threshold:
            break
        if best[top] < 0 or not alive[best[top]] or merges[best[top]] != best_merges[top]:
            stop[top], _, _ = _merged_run(
                start[top], stop[top], start[top], neighbour, inter, extra, root, place_of, top, top
            )
            best[top], value = _best_neighbour(
                top, start[top], stop[top], neighbour, inter, extra, seen, members, shown, shows, place_of
            )
            _set_score(top, value, score, block_best)
            if best[top] >= 0:
                best_merges[top] = merges[best[top]]
            continue
        a, b = min(top, best[top]), max(top, best[top])

        needed = stop[a] - start[a] + stop[b] - start[b]
        if used + needed > len(neighbour):
            neighbour, inter, extra, used = _compacted(needed, alive, start, stop, neighbour, inter, extra)
        first = used
        used, joined_inter, joined_extra = _merged_run(
            start[a], stop[a], used, neighbour, inter, extra, root, place_of, a, b
        )
        used, _, _ = _merged_run(start[b], stop[b], used, neighbour, inter, extra, root, place_of, a, b)
        for k in range(first, used):
            place_of[neighbour[k]] = -1
        start[a], stop[a] = first, used
        within[0, a] += within[0, b] + joined_inter
        within[1, a] += within[1, b] + _plus_sizes(joined_extra, a, b, seen, members, shown, shows)
        seen[a] += seen[b]
        members[a] += members[b]
        shows[a] = 0
        for v in range(num_views):
            if members[a, v] > 0:
                shown[a, shows[a]] = v
                shows[a] += 1
        alive[b] = False
        for i in range(num):
            if root[i] == b:
                root[i] = a
        merges[a] += 1
        best[a] = -1
        _set_score(a, max(score[a], score[b]), score, block_best)
        _set_score(b, -np.inf, score, block_best)
