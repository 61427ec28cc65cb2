"""Link the masks of one level across views: pooled average linkage of their evidence.

Everything is sparse: only masks that share Gaussians can be joined, and how much two clusters see of each
other is a product of two vectors over views. The cost grows with the number of pairs that share Gaussians,
not of all pairs.
"""

import numpy as np
from jaxtyping import Float, Int64

from hilsplat.base.compiled import compiled
from hilsplat.semantic_tree.evidence import Evidence


def pooled_linkage(
    evidence: Evidence, threshold: float
) -> tuple[Int64[np.ndarray, " M"], Float[np.ndarray, " K"]]:
    """Join clusters while the best pair's pooled IoU is at least the threshold.

    The IoU of two clusters is the sum of intersections divided by the sum of unions of all their pairs of
    masks. Pooling is reducible (joining never creates a better pair), so one nearest neighbour per cluster
    suffices. Of equally good pairs, the one with the lowest rows is joined.

    Returns:
        cluster of each mask, numbered by first appearance, and each cluster's pooled IoU over its
        own pairs (0 for a single mask).
    """
    num = len(evidence.view)
    pairs = evidence.intersection
    row = np.repeat(np.arange(num), np.diff(pairs.indptr))
    apart = (
        evidence.seen[row, evidence.view[pairs.indices]] + evidence.seen[pairs.indices, evidence.view[row]]
    )
    members = np.zeros_like(evidence.seen)
    members[np.arange(num), evidence.view] = 1.0
    within = np.zeros((2, num))
    root = np.arange(num)
    _link(
        pairs.indptr.astype(np.int64),
        pairs.indices.astype(np.int64),
        pairs.data.astype(np.float64),
        evidence.union.data - apart,
        evidence.seen.copy(),
        members,
        float(threshold),
        root,
        within,
    )
    # A root is the lowest row of its cluster, so sorting roots numbers clusters by first appearance.
    tops, cluster = np.unique(root, return_inverse=True)
    quality = within[0, tops] / np.where(within[1, tops] > 0, within[1, tops], 1.0)
    return cluster.astype(np.int64), quality


@compiled
def _merged_run(begin, end, first, neighbour, inter, extra, root, place_of, self_a, self_b):
    """Copy a run of neighbours to `first` and beyond; neighbours joined since it was written are summed.

    Entries already there, from an earlier run of the same cluster, are summed too. Entries that lead to
    the cluster itself are left out. Returns the end of the run and the two sums of those left out.
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
def _best_neighbour(i, begin, end, neighbour, inter, extra, seen, members, place_of):
    """The neighbour with the best pooled IoU in a run that `_merged_run` wrote, -1 for none, and that IoU.

    Of equally good ones, the lowest row. Clears the run's marks in `place_of`.
    """
    best, score = -1, -1.0
    for k in range(begin, end):
        j = neighbour[k]
        place_of[j] = -1
        union = extra[k]
        for v in range(seen.shape[1]):
            union += seen[i, v] * members[j, v] + seen[j, v] * members[i, v]
        if union > 0.0:
            pooled = inter[k] / union
            if pooled > score or (pooled == score and j < best):
                best, score = j, pooled
    return best, score


@compiled
def _compacted(needed, alive, start, stop, neighbour, inter, extra):
    """Copy the runs of living clusters to the start of a pool with room for more; updates `start`, `stop`."""
    living = 0
    for i in range(len(alive)):
        if alive[i]:
            living += stop[i] - start[i]
    room = max(len(neighbour), 2 * (living + needed))
    new_neighbour, new_inter, new_extra = np.empty(room, np.int64), np.empty(room), np.empty(room)
    used = 0
    for i in range(len(alive)):
        if alive[i]:
            length = stop[i] - start[i]
            new_neighbour[used : used + length] = neighbour[start[i] : stop[i]]
            new_inter[used : used + length] = inter[start[i] : stop[i]]
            new_extra[used : used + length] = extra[start[i] : stop[i]]
            start[i], stop[i] = used, used + length
            used += length
    return new_neighbour, new_inter, new_extra, used


@compiled
def _link(indptr, indices, pair_inter, pair_extra, seen, members, threshold, root, within):
    """Merge in place; at the end `root` is the lowest row of each mask's cluster.

    A pool holds the clusters' neighbours, one run per cluster: the neighbour, the sum of intersections
    (`inter`), and the sum of the differences between the unions of stored pairs and `seen` (`extra`, never
    positive: sizes count twice what both masks hold). The union of two clusters is `extra` plus, over views,
    the size of each as seen there times the number of the other's members there. Neighbours joined since a
    run was written are summed when it is next read. The run of a merged cluster is written at the end of the
    pool, which is compacted when full.
    """
    num, num_views = seen.shape
    room = 2 * len(indices) + 1024
    neighbour = np.empty(room, np.int64)
    inter, extra = np.empty(room), np.empty(room)
    neighbour[: len(indices)] = indices
    inter[: len(indices)] = pair_inter
    extra[: len(indices)] = pair_extra
    start, stop = indptr[:-1].copy(), indptr[1:].copy()
    used = len(indices)
    alive = np.ones(num, np.bool_)
    best = np.full(num, -1, np.int64)
    # Merges of each cluster so far, and of its best neighbour when that was found. If those differ, the score
    # is only an upper bound, since joining never creates a better pair. Only bounds that come out on top are
    # computed again.
    merges, best_merges = np.zeros(num, np.int64), np.full(num, -1, np.int64)
    score = np.full(num, np.inf)
    place_of = np.full(num, -1, np.int64)
    while True:
        top, value = -1, threshold
        for i in range(num):
            if alive[i] and (score[i] > value or (top < 0 and score[i] >= value)):
                top, value = i, score[i]
        if top < 0:
            break
        if best[top] < 0 or not alive[best[top]] or merges[best[top]] != best_merges[top]:
            stop[top], _, _ = _merged_run(
                start[top], stop[top], start[top], neighbour, inter, extra, root, place_of, top, top
            )
            best[top], score[top] = _best_neighbour(
                top, start[top], stop[top], neighbour, inter, extra, seen, members, place_of
            )
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
        for v in range(num_views):
            joined_extra += seen[a, v] * members[b, v] + seen[b, v] * members[a, v]
        within[0, a] += within[0, b] + joined_inter
        within[1, a] += within[1, b] + joined_extra
        seen[a] += seen[b]
        members[a] += members[b]
        alive[b] = False
        for i in range(num):
            if root[i] == b:
                root[i] = a
        merges[a] += 1
        best[a], score[a] = -1, max(score[a], score[b])
