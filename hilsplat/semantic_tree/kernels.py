"""Compiled loops of evidence, linkage and the pixels of nodes."""

import numpy as np

from cpusplat.compiled import compiled
from hilsplat.contributions.kernels import enlarged

ROWS_OF_A_BLOCK = 256
"""Rows per block; the best score of each block is stored, so finding the best row requires few reads."""


@compiled
def seen_sizes(begin, end, indptr, indices, sizes, visible, out):
    """Write to `out` the size of each mask on the Gaussians visible in each view."""
    for a in range(begin, end):
        for k in range(indptr[a], indptr[a + 1]):
            g = indices[k]
            for v in range(visible.shape[1]):
                out[a, v] += sizes[k] * visible[g, v]


@compiled
def shared_pairs(
    begin, end, indptr, indices, weighted, col_indptr, col_rows, col_shares, view, seen, everywhere
):
    """Return the pairs a < b that share Gaussians: number per row, b, intersections and unions."""
    num = len(indptr) - 1
    touched_by = np.full(num, -1, np.int64)
    sums = np.zeros(num)
    found = np.empty(num, np.int32)
    counts = np.zeros(end - begin, np.int64)
    out, out_sums = np.empty(1024, np.int32), np.empty((1024, 2))
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
            out, out_sums = enlarged(out, out_sums, done, 2 * (done + count))
        for place in range(count):
            b = found[place]
            if seen[a, view[b]] == 0.0 and seen[b, view[a]] == 0.0:
                continue
            out[done] = b
            out_sums[done, 0] = sums[b]
            out_sums[done, 1] = everywhere[a, view[b]] + everywhere[b, view[a]] - sums[b]
            counts[a - begin] += 1
            done += 1
    return counts, out[:done].copy(), out_sums[:done, 0].copy(), out_sums[:done, 1].copy()


@compiled
def initial_neighbours(indptr, indices, intersection, union, seen, view):
    """Return the initial pool of neighbours for `link`, with 25 % spare room, and the bounds of each run."""
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
def link(start, stop, neighbour, inter, extra, seen, view, threshold, root, within):
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


@compiled
def summed_by_node(indptr, indices, data, node_of_gaussian):
    out_indptr = np.zeros(len(indptr), np.int64)
    # untouched pages of these arrays take no memory
    nodes, shares = np.empty(len(indices), np.int32), np.empty(len(indices), np.float32)
    done = 0
    for p in range(len(indptr) - 1):
        first = done
        for k in range(indptr[p], indptr[p + 1]):
            node = node_of_gaussian[indices[k]]
            if node < 0:
                continue
            place = first
            while place < done and nodes[place] != node:
                place += 1
            if place == done:
                nodes[place], shares[place] = node, np.float32(0)
                done += 1
            shares[place] += data[k]
        out_indptr[p + 1] = done
    return out_indptr, nodes[:done].copy(), shares[:done].copy()


@compiled
def blend_nodes(indptr, nodes, shares, covered, values, without, out):
    least = np.float32(np.inf)
    for p in range(len(covered)):
        if not covered[p]:
            continue
        total, left = np.float32(0), np.float32(1)
        for k in range(indptr[p], indptr[p + 1]):
            total += shares[k] * values[nodes[k]]
            left -= shares[k]
        total += max(left, np.float32(0)) * without
        out[p] = total
        least = min(least, total)
    if not least < np.inf:
        least = np.float32(0)
    for p in range(len(covered)):
        if not covered[p]:
            out[p] = least


@compiled
def mask_of_nodes(indptr, nodes, shares, chosen, out):
    for p in range(len(out)):
        total = np.float32(0)
        for k in range(indptr[p], indptr[p + 1]):
            if chosen[nodes[k]]:
                total += shares[k]
        out[p] = total > 0.5
