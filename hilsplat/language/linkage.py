"""Link the masks of one level across views by the Gaussians they share: evidence, then clusters.

Everything is sparse: only masks that share Gaussians can be joined, and how much two clusters see
of each other is a product of two vectors over views. Cost grows with the pairs of masks that share
Gaussians, not with all pairs.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float64, Int32, Int64

from hilsplat.language.quadratic import compiled

ROWS_AT_A_TIME = 64
"""Rows of masks that one thread takes at a time."""


@dataclass(frozen=True)
class Evidence:
    """How far every two of the M masks of a level agree on the Gaussians that both views see.

    Attributes:
        intersection: of pairs that share Gaussians; symmetric, no diagonal, no pair of one view.
        union: of the same pairs, in the same order of stored values.
        seen: size of each mask as each of the V views sees it; its whole size in its own view, 0
            where the view sees too little of it. The union of a pair that is not stored is
            `seen[a, view[b]] + seen[b, view[a]]`; its intersection is 0.
        view: view of each mask.
    """

    intersection: sp.csr_matrix
    union: sp.csr_matrix
    seen: Float64[np.ndarray, "M V"]
    view: Int32[np.ndarray, " M"]

    def pair(self, a: int, b: int) -> tuple[float, float]:
        """Intersection and union of two masks."""
        row = slice(self.intersection.indptr[a], self.intersection.indptr[a + 1])
        found = np.flatnonzero(self.intersection.indices[row] == b)
        if len(found):
            at = row.start + int(found[0])
            return float(self.intersection.data[at]), float(self.union.data[at])
        return 0.0, float(self.seen[a, self.view[b]] + self.seen[b, self.view[a]])


def mask_evidence(
    shares: sp.csr_matrix,
    importance: Float[np.ndarray, " N"],
    visible: Bool[np.ndarray, "V N"],
    view: Int32[np.ndarray, " M"],
    min_covisible: float,
    overlap: str,
    threads: int = 1,
) -> Evidence:
    """Soft intersection and union of every two masks of one level, on the Gaussians both views see.

    With s the share of a Gaussian's visible weight that lies in a mask and w its importance, the
    intersection of a and b is sum w s_a s_b, the size of a as seen from the view of b is the sum of
    w s_a^2 (Tanimoto) or w s_a (soft) over Gaussians visible there. For shares of 0 and 1 the two
    agree. A fitted Gaussian reaches across borders and has shares between: there soft sizes shrink
    the IoU of one region with itself (shares of 0.3 give 0.18), Tanimoto keeps it at 1.

    Two masks of one view are different things: they are evidence against a link (intersection 0,
    union both full sizes). Masks that share Gaussians but see less than `min_covisible` of each
    other, both ways, are no evidence; of masks that share none, each counts as far as the other's
    view sees at least that share of it.

    Args:
        shares: s, one row per mask; zero where the Gaussian is not visible in the mask's view.
        importance: w, such as the mean visible mass.
        visible: which Gaussians each view sees.
        view: view of each mask.
        min_covisible: share below which a pair is dropped.
        overlap: "tanimoto" or "soft".
        threads: rows are shared among them; the bytes do not depend on it.
    """
    data = shares.data.astype(np.float64)
    weight = importance.astype(np.float64)[shares.indices]
    sizes = weight * (np.square(data) if overlap == "tanimoto" else data)
    seen_everywhere = np.zeros((shares.shape[0], len(visible)))
    flags = np.ascontiguousarray(visible.T).view(np.uint8)
    columns = sp.csr_matrix((data, shares.indices, shares.indptr), shape=shares.shape).tocsc()
    rows = (shares.indptr, shares.indices)
    with ThreadPoolExecutor(max(1, threads)) as pool:
        edges = [*range(0, shares.shape[0], ROWS_AT_A_TIME), shares.shape[0]]
        ranges = list(pairwise(edges))
        list(pool.map(lambda span: _seen_sizes(*span, *rows, sizes, flags, seen_everywhere), ranges))
        size = seen_everywhere[np.arange(len(view)), view]
        seen = np.where(seen_everywhere < min_covisible * size[:, None], 0.0, seen_everywhere)
        column_arrays = (columns.indptr, columns.indices, columns.data)
        parts = list(
            pool.map(
                lambda span: _shared_pairs(
                    *span, *rows, weight * data, *column_arrays, view, seen, seen_everywhere
                ),
                ranges,
            )
        )
    lengths = np.concatenate([np.diff(part[0]) for part in parts]) if parts else np.zeros(0, np.int64)
    indptr = np.concatenate(([0], np.cumsum(lengths)))
    shape = (shares.shape[0], shares.shape[0])
    indices = np.concatenate([part[1] for part in parts]) if parts else np.zeros(0, np.int32)
    upper = [
        sp.csr_matrix((np.concatenate([part[k] for part in parts]), indices, indptr), shape=shape)
        if parts
        else sp.csr_matrix(shape)
        for k in (2, 3)
    ]
    # Adding the transposed keeps the two patterns alike: every stored value is positive.
    intersection, union = (sp.csr_matrix(each + each.T) for each in upper)
    intersection.sort_indices()
    union.sort_indices()
    return Evidence(intersection, union, seen, view)


def pooled_linkage(
    evidence: Evidence, threshold: float
) -> tuple[Int64[np.ndarray, " M"], Float[np.ndarray, " K"]]:
    """Join clusters while the best pair's pooled IoU is at least the threshold.

    The IoU of two clusters is the sum of intersections over the sum of unions of all their pairs of
    masks. Pooling is reducible (joining never creates a better pair), so one nearest neighbour per
    cluster is kept. Of equally good pairs the one with the lowest rows is joined.

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
def _seen_sizes(begin, end, indptr, indices, sizes, visible, out):
    """Size of each mask on the Gaussians that each view sees."""
    for a in range(begin, end):
        for k in range(indptr[a], indptr[a + 1]):
            g = indices[k]
            for v in range(visible.shape[1]):
                out[a, v] += sizes[k] * visible[g, v]


@compiled
def _shared_pairs(
    begin, end, indptr, indices, weighted, col_indptr, col_rows, col_shares, view, seen, seen_everywhere
):
    """Pairs a < b that share Gaussians: row starts, b, intersection and union."""
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
            for t in range(col_indptr[g], col_indptr[g + 1]):
                b = col_rows[t]
                if b > a and view[b] != view[a]:
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


@compiled
def _merged_run(begin, end, first, neighbour, inter, extra, root, place_of, self_a, self_b):
    """Copy a run of neighbours to `first` on, those that have been joined since then summed.

    Entries already there (from an earlier run of the same cluster) are summed with it. Entries that
    lead to the cluster itself are left out; their sums are returned. Returns also the end.
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
def _link(indptr, indices, pair_inter, pair_extra, seen, members, threshold, root, within):
    """Merge in place; `root` ends as the lowest row of each mask's cluster.

    A cluster's neighbours lie in a pool, one run per cluster: the neighbour, the sum of intersections
    and the sum of what the unions of stored pairs have beyond `seen`. Neighbours that were joined
    since a run was written are summed when it is next read. A merged cluster's run is written at the
    end of the pool, which is compacted when it is full.
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
    # Merges so far of a cluster, and of its best neighbour when that was found: where they differ the
    # score is only an upper bound, for joining never creates a better pair. Only bounds that come out
    # on top are worked out again.
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
            best[top], score[top] = -1, -1.0
            for k in range(start[top], stop[top]):
                j = neighbour[k]
                place_of[j] = -1
                total = extra[k]
                for v in range(num_views):
                    total += seen[top, v] * members[j, v] + seen[j, v] * members[top, v]
                if total > 0.0:
                    pooled = inter[k] / total
                    if pooled > score[top] or (pooled == score[top] and j < best[top]):
                        best[top], score[top], best_merges[top] = j, pooled, merges[j]
            continue
        a, b = min(top, best[top]), max(top, best[top])

        needed = stop[a] - start[a] + stop[b] - start[b]
        if used + needed > room:
            living = 0
            for i in range(num):
                if alive[i]:
                    living += stop[i] - start[i]
            room = max(room, 2 * (living + needed))
            new_neighbour, new_inter, new_extra = np.empty(room, np.int64), np.empty(room), np.empty(room)
            used = 0
            for i in range(num):
                if alive[i]:
                    length = stop[i] - start[i]
                    new_neighbour[used : used + length] = neighbour[start[i] : stop[i]]
                    new_inter[used : used + length] = inter[start[i] : stop[i]]
                    new_extra[used : used + length] = extra[start[i] : stop[i]]
                    start[i], stop[i] = used, used + length
                    used += length
            neighbour, inter, extra = new_neighbour, new_inter, new_extra

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
