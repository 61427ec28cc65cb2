"""Compiled loops of evidence, linkage and the pixels of nodes."""

import numpy as np

from cpusplat.compiled import compiled
from hilsplat.contributions.kernels import enlarged

ROUNDING = 1e-9
"""Bounds are raised by this share, which is far more than the rounding errors of sums."""

ROWS_OF_A_BLOCK = 256
"""Rows per block; the best score of each block is stored, so finding the best row requires few reads."""


@compiled
def _unpack(view, indptr, indices, data, out, fill):
    """Write a view's values to their columns of `out`, or zeros if `fill` is false; no view if negative."""
    if view >= 0:
        for k in range(indptr[view], indptr[view + 1]):
            out[indices[k]] = data[k] if fill else 0.0


@compiled
def add_views(mass, pair_view, pair_row, order, matrix, out):
    """Add to the entries of row `pair_row` their Gaussians' mass in view `pair_view`, pair by pair.

    `order` lists the pairs view by view, so that the mass of a view is unpacked once.
    """
    mass_indptr, mass_indices, mass_data, num_gaussians = mass
    indptr, indices = matrix
    unpacked = np.zeros(num_gaussians, np.float32)
    current = -1
    for pair in order:
        if pair_view[pair] != current:
            _unpack(current, mass_indptr, mass_indices, mass_data, unpacked, False)
            current = pair_view[pair]
            _unpack(current, mass_indptr, mass_indices, mass_data, unpacked, True)
        row = pair_row[pair]
        for k in range(indptr[row], indptr[row + 1]):
            out[k] += unpacked[indices[k]]


@compiled
def divide_by_unions(mass, row_view, order, node, area, matrix, data):
    """Divide intersections of rows with nodes by their unions: area plus the node's mass minus both."""
    mass_indptr, mass_indices, mass_data, _ = mass
    indptr, indices = matrix
    size = np.zeros(node.max() + 1 if len(node) else 1)
    current = -1
    for row in order:
        if row_view[row] != current:
            current = row_view[row]
            size[:] = 0.0
            for k in range(mass_indptr[current], mass_indptr[current + 1]):
                if node[mass_indices[k]] >= 0:
                    size[node[mass_indices[k]]] += mass_data[k]
        for k in range(indptr[row], indptr[row + 1]):
            data[k] /= area[row] + size[indices[k]] - data[k]


@compiled
def _numbered(begin, end, indices, number):
    """Number the columns of entries begin..end by first appearance in `number`; return how many they are."""
    count = 0
    for k in range(begin, end):
        if number[indices[k]] < 0:
            number[indices[k]] = count
            count += 1
    return count


@compiled
def seen_sizes(begin, end, masks, visible, pairs, out, out_views, full):
    """Write to `out` the size of each mask of views begin..end on the Gaussians visible in each partner.

    The partners are written to `out_views`, and the size in the mask's own view to `full`.
    """
    starts, (indptr, indices, share), importance = masks
    visible_indptr, visible_indices = visible
    (pair_indptr, partners, _), row_start = pairs
    number = np.full(len(importance), -1, np.int32)
    for u in range(begin, end):
        first, last = indptr[starts[u]], indptr[starts[u + 1]]
        count = _numbered(first, last, indices, number)
        width = pair_indptr[u + 1] - pair_indptr[u]
        flags = np.zeros((count, width), np.uint8)
        for p in range(width):
            v = partners[pair_indptr[u] + p]
            for k in range(visible_indptr[v], visible_indptr[v + 1]):
                if number[visible_indices[k]] >= 0:
                    flags[number[visible_indices[k]], p] = 1
        for a in range(starts[u], starts[u + 1]):
            sums = out[row_start[a] : row_start[a + 1]]
            for k in range(indptr[a], indptr[a + 1]):
                seen = flags[number[indices[k]]]
                size = importance[indices[k]] * (share[k] * share[k])
                for p in range(width):
                    sums[p] += size * seen[p]
            for p in range(width):
                out_views[row_start[a] + p] = partners[pair_indptr[u] + p]
                if partners[pair_indptr[u] + p] == u:
                    full[a] = sums[p]
        for k in range(first, last):
            number[indices[k]] = -1


@compiled
def drop_small(row_start, least, sizes):
    """Set sizes below each mask's least to zero."""
    for a in range(len(least)):
        for k in range(row_start[a], row_start[a + 1]):
            if sizes[k] < least[a]:
                sizes[k] = 0.0


@compiled
def shared_pairs(begin, end, masks, pairs, seen, least, min_iou):
    """Return the pairs of masks a < b with an IoU of at least `min_iou`, for masks a of views begin..end.

    Returns:
        number of pairs per mask a, masks b, and two sums per pair: the intersection, and the union minus the
        sizes of both masks (0 if the other view shows less than `least` of the mask); and, of all masks,
        the best partner and IoU among these pairs (-1 for none; on a tie, the lowest partner).
    """
    starts, (indptr, indices, share), importance = masks
    (pair_indptr, partners, mirror), row_start = pairs
    number = np.full(len(importance), -1, np.int32)
    counts = np.zeros(starts[end] - starts[begin], np.int64)
    out, out_sums = np.empty(1024, np.int32), np.empty((1024, 2))
    best, score = np.full(starts[-1], -1, np.int64), np.full(starts[-1], -1.0)
    done = 0
    for u in range(begin, end):
        first, last = indptr[starts[u]], indptr[starts[u + 1]]
        lists = np.zeros(_numbered(first, last, indices, number) + 2, np.int64)
        for k in range(first, last):
            lists[number[indices[k]] + 2] += 1
        # lists[n + 1] is where the list of a Gaussian's masks begins, and where it ends once it is filled
        lists = np.cumsum(lists)
        of, of_weighted = np.empty(last - first, np.int32), np.empty(last - first)
        for a in range(starts[u], starts[u + 1]):
            for k in range(indptr[a], indptr[a + 1]):
                at = lists[number[indices[k]] + 1]
                of[at], of_weighted[at] = a - starts[u], importance[indices[k]] * share[k]
                lists[number[indices[k]] + 1] += 1
        from_a, to_b, sums = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty((1024, 2))
        count = 0
        for p in range(pair_indptr[u], pair_indptr[u + 1]):
            v = partners[p]
            if v <= u:
                continue
            shared = np.zeros((starts[v + 1] - starts[v], starts[u + 1] - starts[u]))
            for b in range(starts[v], starts[v + 1]):
                of_b = shared[b - starts[v]]
                for k in range(indptr[b], indptr[b + 1]):
                    n = number[indices[k]]
                    if n >= 0:
                        for t in range(lists[n], lists[n + 1]):
                            of_b[of[t]] += of_weighted[t] * share[k]
            if count + shared.size > len(to_b):
                room = 2 * (count + shared.size)
                from_a = np.concatenate((from_a, np.empty(room - len(from_a), np.int32)))
                to_b, sums = enlarged(to_b, sums, count, room)
            for b in range(starts[v], starts[v + 1]):
                for a in range(starts[u], starts[u + 1]):
                    both = shared[b - starts[v], a - starts[u]]
                    if both == 0.0:
                        continue
                    size_a = seen[row_start[a] + p - pair_indptr[u]]
                    size_b = seen[row_start[b] + mirror[p]]
                    enough_a = size_a if size_a >= least[a] else 0.0
                    enough_b = size_b if size_b >= least[b] else 0.0
                    if enough_a == 0.0 and enough_b == 0.0:
                        continue
                    extra = size_a + size_b - both - (enough_a + enough_b)
                    pooled = both / (extra + enough_b + enough_a)  # summed as in `_union`
                    if pooled < min_iou:
                        continue
                    from_a[count], to_b[count], sums[count, 0], sums[count, 1] = a, b, both, extra
                    count += 1
                    if pooled > score[a]:
                        best[a], score[a] = b, pooled
                    if pooled > score[b]:
                        best[b], score[b] = a, pooled
        for k in range(first, last):
            number[indices[k]] = -1
        if done + count > len(out):
            out, out_sums = enlarged(out, out_sums, done, 2 * (done + count))
        places = np.zeros(starts[u + 1] - starts[u] + 1, np.int64)
        for k in range(count):
            places[from_a[k] - starts[u] + 1] += 1
        counts[starts[u] - starts[begin] : starts[u + 1] - starts[begin]] = places[1:]
        places = done + np.cumsum(places)
        for k in range(count):  # by mask a; masks b stay in order
            at = places[from_a[k] - starts[u]]
            out[at], out_sums[at] = to_b[k], sums[k]
            places[from_a[k] - starts[u]] += 1
        done += count
    return counts, out[:done].copy(), out_sums[:done].copy(), best, score


@compiled
def _merged_run(begin, end, first, ids, values, root, place_of, self_a, self_b):
    """Copy a run of neighbours to position `first`, and sum entries merged after it was written.

    Entries copied there from an earlier run of the cluster are summed too. Entries that refer to the
    cluster itself are omitted. Returns the end of the run and the two sums of the omitted entries.
    """
    own_inter, own_extra = 0.0, 0.0
    last = first
    for k in range(begin, end):
        c = root[ids[k]]
        value, more = values[k, 0], values[k, 1]
        if c in (self_a, self_b):
            own_inter += value
            own_extra += more
        elif place_of[c] < 0:
            place_of[c] = last
            ids[last], values[last, 0], values[last, 1], values[last, 2] = c, value, more, values[k, 2]
            last += 1
        else:
            at = place_of[c]
            values[at, 0] += value
            values[at, 1] += more
            values[at, 2] = max(values[at, 2], values[k, 2])
    return last, own_inter, own_extra


@compiled
def _united_run(a, b, first, runs):
    """Write the sum of two runs with ascending ids to `first` as the run of `a`, and return its end."""
    start, stop, ids, values = runs
    at_a, at_b, last = start[a], start[b], first
    while at_a < stop[a] or at_b < stop[b]:
        use_a = at_a < stop[a] and (at_b == stop[b] or ids[at_a] <= ids[at_b])
        use_b = at_b < stop[b] and (at_a == stop[a] or ids[at_b] <= ids[at_a])
        ids[last] = ids[at_a] if use_a else ids[at_b]
        values[last, 0] = (values[at_a, 0] if use_a else 0.0) + (values[at_b, 0] if use_b else 0.0)
        at_a += use_a
        at_b += use_b
        last += 1
    start[a], stop[a] = first, last
    return last


@compiled
def _unpack_sizes(i, sizes, out, fill):
    """Write a cluster's sizes to their views in `out`, or zeros if `fill` is false."""
    start, stop, views, values = sizes
    for k in range(start[i], stop[i]):
        out[views[k]] = values[k, 0] if fill else 0.0


@compiled
def _union(i, j, extra, size_of_i, sizes, members):
    """Return `extra` plus, view by view, each cluster's size times the number of the other's masks there."""
    start, stop, size_views, size_values = sizes
    member_start, member_stop, views, counts = members
    num_views, first, last = len(size_of_i), start[j], stop[j]
    at_i, end_i, at_j, end_j = member_start[i], member_stop[i], member_start[j], member_stop[j]
    union = extra
    while at_i < end_i or at_j < end_j:
        view_i = views[at_i] if at_i < end_i else num_views
        view_j = views[at_j] if at_j < end_j else num_views
        more = 0.0
        if view_j <= view_i:
            more = size_of_i[view_j] * counts[at_j, 0]
            at_j += 1
        if view_i <= view_j:
            at = first + view_i
            if last - first < num_views:  # some views are left out
                at = first + np.searchsorted(size_views[first:last], view_i)
            if at < last and size_views[at] == view_i:
                more += size_values[at, 0] * counts[at_i, 0]
            at_i += 1
        union += more
    return union


@compiled
def neighbour_runs(indptr, indices, sums):
    """Return runs of neighbours for `link` (start, stop, ids, values), with 25 % spare room."""
    num = len(indptr) - 1
    start = np.zeros(num + 1, np.int64)
    for a in range(num):
        start[a + 1] += indptr[a + 1] - indptr[a]
        for k in range(indptr[a], indptr[a + 1]):
            start[indices[k] + 1] += 1
    start = np.cumsum(start)[:num]
    stop = start.copy()
    room = 2 * len(indices) + len(indices) // 2 + 1024
    ids, values = np.empty(room, np.int32), np.empty((room, 3))
    for a in range(num):  # rows in order, so that each run's neighbours are also in order
        for k in range(indptr[a], indptr[a + 1]):
            b = np.int64(indices[k])
            for own, other in ((a, b), (b, a)):
                ids[stop[own]] = other
                values[stop[own], :2] = sums[k]
                values[stop[own], 2] = np.inf
                stop[own] += 1
    return start, stop, ids, values


@compiled
def _best_neighbour(i, neighbours, size_of_i, sizes, members, place_of):
    """Return the neighbour with the best pooled IoU in a run of `_merged_run` (-1: none), and that IoU.

    On a tie, the lowest row is returned. The run's marks in `place_of` are cleared.

    The third value of an entry bounds its IoU, because joining never creates a better pair. A union is at
    least its terms that need no size of the neighbour, which also bounds the IoU. Most neighbours are below
    the best by these bounds, so that their sizes, which are far apart in memory, aren't read.
    """
    start, stop, ids, values = neighbours
    first, last = start[i], stop[i]
    promising = first
    for k in range(first, last):
        place_of[ids[k]] = -1
        if values[k, 2] == np.inf:
            values[k, 2] = _bound(ids[k], values[k], size_of_i, members)
        if values[k, 2] > values[promising, 2]:
            promising = k
    best, score = -1, -1.0
    for k in range(first - 1, last if first < last else first - 1):
        entry = promising if k < first else k
        if values[entry, 2] < score:
            continue
        j = ids[entry]
        values[entry, 2] = min(values[entry, 2], _bound(j, values[entry], size_of_i, members))
        if values[entry, 2] < score:
            continue
        union = _union(i, j, values[entry, 1], size_of_i, sizes, members)
        if union > 0.0:
            pooled = values[entry, 0] / union
            values[entry, 2] = pooled * (1 + ROUNDING)
            if pooled > score or (pooled == score and j < best):
                best, score = j, pooled
    return best, score


@compiled
def _bound(j, value, size_of_i, members):
    """Return an upper bound of the IoU with neighbour `j`, from the terms of the union without its sizes."""
    start, stop, views, counts = members
    least = value[1]
    for m in range(start[j], stop[j]):
        least += size_of_i[views[m]] * counts[m, 0]
    return value[0] / least * (1 + ROUNDING) if least > 0.0 else np.inf


@compiled
def _with_room(needed, used, alive, runs):
    """Return runs with room for `needed` entries after position `used`, and that position.

    If there is none, runs of existing clusters are moved to the front, or to larger arrays.
    """
    start, stop, ids, values = runs
    if used + needed <= len(ids):
        return runs, used
    living = 0
    for i in range(len(alive)):
        if alive[i]:
            living += stop[i] - start[i]
    to_ids, to_values = ids, values
    if living + needed > len(ids):
        room = (living + needed) * 5 // 4
        to_ids, to_values = np.empty(room, np.int32), np.empty((room, values.shape[1]))
    used = 0
    for i in np.argsort(start):  # in the order of the runs, so that none overwrites one that isn't moved yet
        if alive[i]:
            begin, start[i] = start[i], used
            for k in range(begin, stop[i]):
                to_ids[used] = ids[k]
                to_values[used] = values[k]
                used += 1
            stop[i] = used
    return (start, stop, to_ids, to_values), used


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
def link(neighbours, best, score, sizes, members, num_views, threshold, root, within):
    """Merge clusters in place; afterwards `root` is the lowest row of each mask's cluster.

    Three sets of runs (start, stop, ids, values) describe the clusters. `neighbours`: the neighbour, the sum
    of intersections, the sum of the differences between the unions of stored pairs and `sizes` (never
    positive, because sizes count the overlap of two masks twice), and a bound of the IoU. `sizes`: the view,
    and the cluster's size there. `members`: the view, and the number of the cluster's masks there. The union
    of two clusters is the second sum plus, over views, the size of each cluster in the view times the number
    of the other cluster's masks there. Neighbours merged after a run was written are summed when it is next
    read. Runs of a merged cluster are written at the end.
    """
    num = len(root)
    alive = np.ones(num, np.bool_)
    used = used_sizes = used_members = 0
    if num:
        used, used_sizes, used_members = neighbours[1][-1], sizes[1][-1], members[1][-1]
    # Number of merges of each cluster, and of its best neighbour when the neighbour was found. If the
    # neighbour has merged since, the score is only an upper bound, because joining never creates a better
    # pair. A bound is recomputed only when it is the best score.
    merges, best_merges = np.zeros(num, np.int64), np.zeros(num, np.int64)
    # the masks of each cluster, as a chain from its root
    following, final = np.full(num, -1, np.int64), np.arange(num)
    block_best = np.full(num // ROWS_OF_A_BLOCK + 1, -np.inf)
    for row in range(num):
        block_best[row // ROWS_OF_A_BLOCK] = max(block_best[row // ROWS_OF_A_BLOCK], score[row])
    place_of = np.full(num, -1, np.int64)
    size_of = np.zeros(num_views)
    while True:
        top = _best_row(score, block_best)
        if top < 0 or score[top] < threshold:
            break
        start, stop, ids, values = neighbours
        if best[top] < 0 or not alive[best[top]] or merges[best[top]] != best_merges[top]:
            stop[top], _, _ = _merged_run(
                start[top], stop[top], start[top], ids, values, root, place_of, top, top
            )
            _unpack_sizes(top, sizes, size_of, True)
            best[top], value = _best_neighbour(top, neighbours, size_of, sizes, members, place_of)
            _unpack_sizes(top, sizes, size_of, False)
            _set_score(top, value, score, block_best)
            if best[top] >= 0:
                best_merges[top] = merges[best[top]]
            continue
        a, b = min(top, best[top]), max(top, best[top])

        needed = stop[a] - start[a] + stop[b] - start[b]
        neighbours, used = _with_room(needed, used, alive, neighbours)
        start, stop, ids, values = neighbours
        first = used
        used, joined_inter, joined_extra = _merged_run(
            start[a], stop[a], used, ids, values, root, place_of, a, b
        )
        used, _, _ = _merged_run(start[b], stop[b], used, ids, values, root, place_of, a, b)
        for k in range(first, used):
            place_of[ids[k]] = -1
        start[a], stop[a] = first, used
        within[0, a] += within[0, b] + joined_inter
        _unpack_sizes(a, sizes, size_of, True)
        within[1, a] += within[1, b] + _union(a, b, joined_extra, size_of, sizes, members)
        _unpack_sizes(a, sizes, size_of, False)
        needed = sizes[1][a] - sizes[0][a] + sizes[1][b] - sizes[0][b]
        sizes, used_sizes = _with_room(needed, used_sizes, alive, sizes)
        used_sizes = _united_run(a, b, used_sizes, sizes)
        needed = members[1][a] - members[0][a] + members[1][b] - members[0][b]
        members, used_members = _with_room(needed, used_members, alive, members)
        used_members = _united_run(a, b, used_members, members)
        alive[b] = False
        following[final[a]], final[a] = b, final[b]
        mask = b
        while mask >= 0:
            root[mask] = a
            mask = following[mask]
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
