"""Compiled loops of evidence, linkage and the pixels of nodes."""

import heapq

import numpy as np

from cpusplat.compiled import compiled
from hilsplat.contributions.kernels import enlarged

MAX_READS = 2  # a cluster's neighbours are read this many times before those that have been joined become one


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
            if current >= 0:  # a view sees few of all Gaussians
                unpacked[mass_indices[mass_indptr[current] : mass_indptr[current + 1]]] = 0.0
            current = pair_view[pair]
            begin, end = mass_indptr[current], mass_indptr[current + 1]
            unpacked[mass_indices[begin:end]] = mass_data[begin:end]
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
def _more_pairs(firsts, seconds, sums, count, room):
    """Return larger copies of three arrays with their first `count` entries."""
    more = np.empty(room, np.int32)
    more[:count] = firsts[:count]
    return more, *enlarged(seconds, sums, count, room)


@compiled
def shared_pairs(begin, end, masks, pairs, seen, least, min_iou):
    """Return the pairs of masks a < b with an IoU of at least `min_iou`, for masks a of views begin..end.

    Returns:
        masks a and masks b, in ascending order, and three numbers per pair: the intersection, the union minus
        the sizes of both masks (0 if the other view shows less than `least` of the mask), and the IoU.
    """
    starts, (indptr, indices, share), importance = masks
    (pair_indptr, partners, mirror), row_start = pairs
    number = np.full(len(importance), -1, np.int32)
    firsts, seconds, out_sums = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty((1024, 3))
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
        from_a, to_b, sums = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty((1024, 3))
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
                from_a, to_b, sums = _more_pairs(from_a, to_b, sums, count, room)
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
                    from_a[count], to_b[count] = a, b
                    sums[count, 0], sums[count, 1], sums[count, 2] = both, extra, pooled
                    count += 1
        for k in range(first, last):
            number[indices[k]] = -1
        if done + count > len(firsts):
            firsts, seconds, out_sums = _more_pairs(firsts, seconds, out_sums, done, 2 * (done + count))
        places = np.zeros(starts[u + 1] - starts[u] + 1, np.int64)
        for k in range(count):
            places[from_a[k] - starts[u] + 1] += 1
        places = done + np.cumsum(places)
        for k in range(count):  # by mask a; masks b stay in order
            at = places[from_a[k] - starts[u]]
            firsts[at], seconds[at], out_sums[at] = from_a[k], to_b[k], sums[k]
            places[from_a[k] - starts[u]] += 1
        done += count
    return firsts[:done], seconds[:done], out_sums[:done]  # untouched pages beyond take no memory


@compiled
def add_neighbours(firsts, seconds, sums, stop, ids, values):
    """Add these pairs to the runs of neighbours of both masks, which end at `stop`."""
    for k in range(len(firsts)):
        a, b = np.int64(firsts[k]), np.int64(seconds[k])
        for node, other in ((a, b), (b, a)):
            ids[stop[node]] = other
            values[stop[node], 0], values[stop[node], 1] = sums[k, 0], sums[k, 1]
            stop[node] += 1


@compiled
def _sums_with(i, j, neighbours, following, cluster):
    """Return a cluster's two sums with cluster `j`; its runs of neighbours are a chain from `i`."""
    start, stop, ids, values = neighbours
    both, extra, run = 0.0, 0.0, i
    while run >= 0:
        for k in range(start[run], stop[run]):
            if cluster[ids[k]] == j:
                both += values[k, 0]
                extra += values[k, 1]
        run = following[run]
    return both, extra


@compiled
def _shorten(i, j, neighbours, following, cluster, place_of):
    """Shorten a cluster's runs before it joins `j`; return the number of neighbours left, and the last run.

    Neighbours that have been joined become one, and `j`, the cluster itself and empty runs are dropped.
    """
    start, stop, ids, values = neighbours
    total, last_run, run = 0, i, i
    while run >= 0:
        last = start[run]
        for k in range(start[run], stop[run]):
            c = cluster[ids[k]]
            if c in (i, j):
                continue
            at = place_of[c]
            if at < 0:
                place_of[c] = last
                ids[last], values[last, 0], values[last, 1] = c, values[k, 0], values[k, 1]
                last += 1
            else:
                values[at, 0] += values[k, 0]
                values[at, 1] += values[k, 1]
        stop[run] = last
        total += last - start[run]
        if last > start[run] and run != i:
            following[last_run] = run
            last_run = run
        run = following[run]
    following[last_run] = -1
    run = i
    while run >= 0:
        for k in range(start[run], stop[run]):
            place_of[ids[k]] = -1
        run = following[run]
    return total, last_run


@compiled
def _place(view, begin, end, views):
    """Return the place of a view in an ascending run, or where it would be, and whether it is there.

    The search begins in steps of growing length, because the place is usually near `begin`.
    """
    step = 1
    while begin + step <= end and views[begin + step - 1] < view:
        begin += step
        step *= 2
    first, above = begin, min(begin + step - 1, end)
    while first < above:
        middle = (first + above) // 2
        if views[middle] < view:
            first = middle + 1
        else:
            above = middle
    return first, first < end and views[first] == view


@compiled
def _union(i, j, extra, sizes, members):
    """Return `extra` plus, view by view, each cluster's size times the number of the other's masks there.

    Only views of `i` are read, because in others it has neither a size nor a mask.
    """
    start, stop, size_views, size_values = sizes[:4]
    member_start, member_stop, views, counts = members[:4]
    at, end, member, member_end = start[i], stop[i], member_start[i], member_stop[i]
    other, other_member = start[j], member_start[j]
    union = extra
    while at < end or member < member_end:
        has_size = at < end and (member == member_end or size_views[at] <= views[member])
        has_masks = member < member_end and (at == end or views[member] <= size_views[at])
        more = 0.0
        if has_size:
            other_member, is_there = _place(size_views[at], other_member, member_stop[j], views)
            if is_there:
                more += size_values[at] * counts[other_member]
            at += 1
        if has_masks:
            other, is_there = _place(views[member], other, stop[j], size_views)
            if is_there:
                more += size_values[other] * counts[member]
            member += 1
        union += more
    return union


@compiled
def _with_room(needed, used, runs):
    """Return runs with room for `needed` entries after position `used`, and that position.

    If there is none, the runs are copied to the spare arrays, without the gaps between them.
    """
    start, stop, ids, values, to_ids, to_values = runs
    if used + needed <= len(ids):
        return runs, used
    room = (np.sum(stop - start) + needed) * 5 // 4
    if room > len(to_ids):
        to_ids, to_values = np.empty(room, np.int32), np.empty(room)
    used = 0
    for i in range(len(start)):
        begin, start[i] = start[i], used
        for k in range(begin, stop[i]):
            to_ids[used], to_values[used] = ids[k], values[k]
            used += 1
        stop[i] = used
    return (start, stop, to_ids, to_values, ids, values), used


@compiled
def _unite(i, j, used, runs):
    """Add the run of `i` to that of `j`, in place or after position `used`; return the runs and `used`."""
    start, stop, ids, values = runs[:4]
    more, most = (j, i) if stop[i] - start[i] > stop[j] - start[j] else (i, j)
    at, is_inside = start[most], True
    for k in range(start[more], stop[more]):
        at, is_there = _place(ids[k], at, stop[most], ids)
        is_inside = is_inside and is_there
    if is_inside:
        at = start[most]
        for k in range(start[more], stop[more]):
            at, _ = _place(ids[k], at, stop[most], ids)
            values[at] += values[k]
        start[j], stop[j] = start[most], stop[most]
        start[i], stop[i] = 0, 0
        return runs, used
    runs, used = _with_room(stop[i] - start[i] + stop[j] - start[j], used, runs)
    start, stop, ids, values = runs[:4]
    at_i, at_j, last = start[i], start[j], used
    while at_i < stop[i] or at_j < stop[j]:
        use_i = at_i < stop[i] and (at_j == stop[j] or ids[at_i] <= ids[at_j])
        use_j = at_j < stop[j] and (at_i == stop[i] or ids[at_j] <= ids[at_i])
        ids[last] = ids[at_i] if use_i else ids[at_j]
        values[last] = (values[at_i] if use_i else 0.0) + (values[at_j] if use_j else 0.0)
        at_i += use_i
        at_j += use_j
        last += 1
    start[j], stop[j] = used, last
    start[i], stop[i] = 0, 0
    return runs, last


@compiled
def link(pairs, neighbours, sizes, members, threshold, root, within):
    """Merge clusters in place; afterwards `root` is the lowest row of each mask's cluster.

    `pairs`: first mask, second mask and IoU of the pairs of masks at or above the threshold, best first.
    Three sets of runs (start, stop, ids, values) describe the clusters. `neighbours`: the neighbour, the sum
    of intersections, and the sum of the differences between the unions of stored pairs and `sizes` (never
    positive, because sizes count the overlap of two masks twice). `sizes`: the view, and the cluster's size
    there. `members`: the view, and the number of the cluster's masks there. The last two end with spare
    arrays for `_with_room`. The union of two clusters is the second sum plus, over views, the size of each
    cluster in the view times the number of the other cluster's masks there.

    Joining never creates a better pair. So two clusters need to be compared only when the best IoU of two of
    their parts becomes the best of all, and the smaller cluster's neighbours and views suffice for that.
    """
    firsts, seconds, ious = pairs
    num = len(root)
    # a cluster has the number of one of its masks; its masks and its runs of neighbours are chains from there
    cluster, lowest, num_masks = np.arange(num).astype(np.int32), np.arange(num), np.ones(num, np.int64)
    following, last_mask = np.full(num, -1, np.int64), np.arange(num)
    following_run, last_run = np.full(num, -1, np.int64), np.arange(num)  # a shortened chain keeps its first
    num_neighbours, num_read = neighbours[1] - neighbours[0], np.zeros(num, np.int64)
    place_of = np.full(num, -1, np.int64)
    used_sizes, used_members = len(sizes[2]), len(members[2])
    # A comparison is outdated when one of the clusters has grown, which its number of masks shows.
    # compared clusters: negative IoU, lowest masks, number of masks, intersection, union
    queue = [(0.0, 0, 0, 0, 0.0, 0.0)]
    queue.pop()
    compared = {(0, 0): 0}  # two clusters -> number of masks when they were compared
    at = 0
    while at < len(ious) or len(queue):
        num_compared, both, union = 0, 0.0, 0.0
        if not len(queue) or (at < len(ious) and (-ious[at], firsts[at], seconds[at]) < queue[0][:3]):
            a, b = np.int64(firsts[at]), np.int64(seconds[at])
            at += 1
        else:
            _, a, b, num_compared, both, union = heapq.heappop(queue)
        i, j = np.int64(cluster[a]), np.int64(cluster[b])
        if i == j:
            continue
        together = num_masks[i] + num_masks[j]
        if num_neighbours[i] > num_neighbours[j]:
            i, j = j, i
        if num_compared != together:
            key = min(i, j), max(i, j)
            if key in compared and compared[key] == together:
                continue
            num_read[i] += num_neighbours[i]
            if num_read[i] > MAX_READS * num_neighbours[i]:
                num_neighbours[i], last_run[i] = _shorten(i, i, neighbours, following_run, cluster, place_of)
                num_read[i] = 0
            both, extra = _sums_with(i, j, neighbours, following_run, cluster)
            few, many = (j, i) if sizes[1][i] - sizes[0][i] > sizes[1][j] - sizes[0][j] else (i, j)
            union = _union(few, many, extra, sizes, members)
            if together > 2:
                compared[key] = together
                if union > 0.0 and both / union >= threshold:
                    a, b = min(lowest[i], lowest[j]), max(lowest[i], lowest[j])
                    heapq.heappush(queue, (-both / union, a, b, together, both, union))
                continue
        within[0, j] += within[0, i] + both
        within[1, j] += within[1, i] + union
        sizes, used_sizes = _unite(i, j, used_sizes, sizes)
        members, used_members = _unite(i, j, used_members, members)
        num_masks[j] = together
        lowest[j] = min(lowest[i], lowest[j])
        more, last = _shorten(i, j, neighbours, following_run, cluster, place_of)
        num_neighbours[j] += more
        following_run[last_run[j]], last_run[j] = i, last
        following[last_mask[j]], last_mask[j] = i, last_mask[i]
        mask = i
        while mask >= 0:
            cluster[mask] = j
            mask = following[mask]
    for mask in range(num):
        root[mask] = lowest[cluster[mask]]
    within[:] = within[:, cluster]


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
            at = first
            while at < done and nodes[at] != node:
                at += 1
            if at == done:
                nodes[at], shares[at] = node, np.float32(0)
                done += 1
            shares[at] += data[k]
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
