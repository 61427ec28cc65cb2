"""Compiled loops that sum weights of Gaussians over masks, and products of weights over pixels."""

import numpy as np

from cpusplat.compiled import compiled
from cpusplat.lanes import WIDTH, add_products, lanes, load, plus, prefetch, store

SUMS = 4  # number of sums per pair that are stored as one vector: one per level, plus padding
AHEAD = 8  # weights of W are fetched into the cache this many pixels before they are needed

PLACE = np.uint64(2**32 - 1)
"""Bits of a cell (see `transpose`) that contain its place; the higher bits contain its row."""

BLOCK = 2**15
"""Number of Gaussians per pass of a wide product with A: their features fit into the processor's cache."""


@compiled
def summed_masks(first, last, runs, offsets, level_of, labels, half, indptr, indices, data, num_gaussians):
    """Sum weights over masks first..last, and count the summed pixels.

    Args:
        runs, offsets: as in `HierarchicalMasks`.
        labels: painted mask of each pixel and level, -1 for none.
        half: whether each pixel is in the random half.
        indptr, indices, data: W in CSR form, with positive weights; pixels without weights are ignored.

    Returns:
        counts (masks x 2) of painted pixels and of painted pixels in the half; row sizes; columns; sums over
        raw masks, painted pixels, and painted pixels in the half (entries x 3, float64, in pixel order).
    """
    sums, gaussians = np.zeros(num_gaussians * SUMS), np.empty(num_gaussians, np.int32)
    counts = np.zeros((last - first, 2), np.int64)
    sizes = np.zeros(last - first, np.int64)
    columns, values = np.empty(1024, np.int32), np.empty((1024, 3))
    done = 0
    for m in range(first, last):
        count, pixel, level = 0, np.int64(0), level_of[m] - 1
        for run in range(offsets[m], offsets[m + 1]):
            begin, pixel = pixel, pixel + np.int64(runs[run])
            if (run - offsets[m]) % 2 == 0:
                continue  # outside
            for p in range(begin, pixel):
                if indptr[p] == indptr[p + 1]:
                    continue
                painted = 1.0 if labels[p, level] == m else 0.0
                in_half = painted if half[p] else 0.0
                counts[m - first, 0] += painted > 0
                counts[m - first, 1] += in_half > 0
                for k in range(indptr[p], indptr[p + 1]):
                    j = np.uint64(indices[k])  # unsigned: skips the check for negative indices
                    at, weight = np.int64(j) * SUMS, np.float64(data[k])
                    if add_products(sums, at, 1.0, painted, in_half, weight) == 0:
                        gaussians[count] = np.int32(j)
                        count += 1
        gaussians[:count] = np.sort(gaussians[:count])
        if done + count > len(columns):
            columns, values = enlarged(columns, values, done, 2 * (done + count))
        for k in range(count):
            at = np.int64(gaussians[k]) * SUMS
            columns[done + k] = gaussians[k]
            values[done + k] = sums[at : at + 3]
            sums[at : at + SUMS] = 0
        done += count
        sizes[m - first] = count
    return counts, sizes, columns[:done], values[:done]


@compiled
def move_to_front(rows, indptr, indices, data):
    """Move the weights of some rows of W to the front of its arrays, and return the number of weights."""
    done = np.uint64(0)  # unsigned: skips the check for negative indices
    for row in rows:
        for k in range(np.uint64(indptr[row]), np.uint64(indptr[row + 1])):
            indices[done], data[done] = indices[k], data[k]
            done += np.uint64(1)
    return done


@compiled
def transpose(indptr, indices, begins, cells):
    """Write each column's start to `begins`, and the cells of its values, row * 2**32 + place, to `cells`.

    `begins` must contain zeros. All integers are unsigned, which skips the checks for negative indices.
    """
    for k in range(np.uint64(indptr[-1])):
        begins[np.uint64(indices[k]) + np.uint64(1)] += 1
    begins[:] = np.cumsum(begins)
    filled = begins[:-1].astype(np.uint32)
    for p in range(len(indptr) - 1):
        for k in range(np.uint64(indptr[p]), np.uint64(indptr[p + 1])):
            j = np.uint64(indices[k])
            at = np.uint64(filled[j])
            cells[at] = (np.uint64(p) << np.uint64(32)) | k
            filled[j] = np.uint32(at + np.uint64(1))


@compiled
def enlarged(indices, values, count, room):
    """Return larger copies of both arrays with their first `count` entries."""
    more_indices = np.empty(room, np.int32)
    more_values = np.empty((room, values.shape[1]), np.float64)
    more_indices[:count], more_values[:count] = indices[:count], values[:count]
    return more_indices, more_values


@compiled
def add_to_block(
    begin, end, part, columns, rows, late, number, sums, fresh, out_indptr, out_indices, out_values
):
    """Add the pixels of a part to rows begin..end of G.

    Pairs in `rows` are summed in place; pairs in `late` and new pairs are written to the output. A row's
    pairs are numbered from 1, first those of `rows`, then of `late`, so its sums fit into the fastest cache.

    Args:
        part: row starts, columns and values of W, and whether each pixel has a mask at each level.
        columns: output of `transpose` for the part: starts and cells.
        rows, late: row starts, columns, and sums by level (E x 3); no pair is in both.
        number: an integer per Gaussian, zero before and after the call.
        sums: buffer for SUMS numbers per Gaussian and SUMS more.
        fresh: buffer for new columns, one number per Gaussian.
        out_indptr, out_indices, out_values: late pairs; columns are sorted within rows.

    Returns:
        `out_indices` and `out_values`, or larger copies if they were too small.
    """
    indptr, indices, data, valid = part
    begins, cells = columns
    row_indptr, row_indices, row_values = rows
    late_indptr, late_indices, late_values = late
    levels = row_values.shape[1]
    done = 0
    for i in range(begin, end):
        first, last = row_indptr[i - begin], row_indptr[i - begin + 1]
        old, old_end = late_indptr[i - begin], late_indptr[i - begin + 1]
        known, is_seen = last - first + old_end - old, begins[i] < begins[i + 1]
        count = known
        if is_seen:
            _number(first, last, row_indices, row_values, 0, number, sums)
            _number(old, old_end, late_indices, late_values, last - first, number, sums)
        for t in range(begins[i], begins[i + 1]):
            p, entry = cells[t] >> np.uint64(32), cells[t] & PLACE
            ahead = np.int64(cells[min(t + AHEAD, len(cells) - 1)] & PLACE)
            prefetch(indices, ahead)
            prefetch(data, ahead)
            weight = np.float64(data[entry])
            whole = weight if valid[p, 0] else 0.0
            part_weight = weight if valid[p, 1] else 0.0
            subpart = weight if valid[p, 2] else 0.0
            for k in range(entry, np.uint64(indptr[p + 1])):
                j = np.uint64(indices[k])  # unsigned: skips the check for negative indices
                at = np.int64(number[j])
                if at == 0:
                    fresh[count - known] = np.int32(j)
                    count += 1
                    at = np.int64(count)
                    number[j] = np.int32(count)
                    sums[at * SUMS : at * SUMS + SUMS] = 0
                add_products(sums, at * SUMS, whole, part_weight, subpart, np.float64(data[k]))
        count -= known
        if count:
            fresh[:count] = np.sort(fresh[:count])
        size = old_end - old + count
        if done + size > len(out_indices):
            out_indices, out_values = enlarged(out_indices, out_values, done, 2 * (done + size))
        if is_seen:
            for k in range(first, last):
                number[row_indices[k]] = 0
                for level in range(levels):
                    row_values[k, level] = sums[(k - first + 1) * SUMS + level]
            new = 0
            for entry in range(done, done + size):
                if new < count and (old == old_end or fresh[new] < late_indices[old]):
                    column = fresh[new]
                    new += 1
                else:
                    column = late_indices[old]
                    old += 1
                out_indices[entry] = column
                for level in range(levels):
                    out_values[entry, level] = sums[np.int64(number[column]) * SUMS + level]
                number[column] = 0
        else:
            out_indices[done : done + size] = late_indices[old:old_end]
            out_values[done : done + size] = late_values[old:old_end]
        done += size
        out_indptr[i - begin + 1] = done
    return out_indices, out_values


@compiled
def _number(first, last, indices, values, before, number, sums):
    """Number the pairs first..last from `before` + 1, and load their sums."""
    for k in range(first, last):
        at = before + k - first + 1
        number[indices[k]] = np.int32(at)
        for level in range(values.shape[1]):
            sums[at * SUMS + level] = values[k, level]


@compiled
def merge_rows(indptr, indices, values, late_indptr, late_indices, late_values):
    """Merge late pairs into the rows in place, from the end; `indices` and `values` must have enough room."""
    at = indptr[-1] + late_indptr[-1]
    for i in range(len(indptr) - 2, -1, -1):
        k, t = indptr[i + 1] - 1, late_indptr[i + 1] - 1
        if at == k + 1:
            break  # no late pair is left
        indptr[i + 1] = at
        while k >= indptr[i] or t >= late_indptr[i]:
            at -= 1
            if t < late_indptr[i] or (k >= indptr[i] and indices[k] > late_indices[t]):
                indices[at] = indices[k]
                values[at] = values[k]
                k -= 1
            else:
                indices[at] = late_indices[t]
                values[at] = late_values[t]
                t -= 1


@compiled
def normalise(indptr, indices, data, min_alpha):
    done, begin = np.uint64(0), np.uint64(indptr[0])  # unsigned: skips the check for negative indices
    for row in range(len(indptr) - 1):
        end = np.uint64(indptr[row + 1])
        alpha = 0.0
        for k in range(begin, end):
            alpha += data[k]
        if alpha >= min_alpha:
            for k in range(begin, end):
                indices[done] = indices[k]
                data[done] = data[k] / alpha
                done += np.uint64(1)
        begin, indptr[row + 1] = end, done
    return done


@compiled
def add_columns(indices, data, out):
    for k in range(len(indices)):
        out[indices[k]] += data[k]


@compiled
def render_rows(indptr, indices, data, pixels, share, features, wide, out):
    for row in range(len(pixels)):
        p = pixels[row]
        begin, end = np.uint64(indptr[p]), np.uint64(indptr[p + 1])
        for c in range(0, wide, WIDTH):
            total = lanes(np.float32(0))
            for k in range(begin, end):
                total = plus(total, lanes(data[k]), load(features, np.int64(indices[k]) * wide + c))
            store(out, row * wide + c, total / lanes(share[row]))


@compiled
def weights_product(level, last, first, across, indptr, indices, data, valid, features, width, out):
    """Add W' diag(valid) W F of one level to `out`, which contains Gaussian `first` and those after it.

    With `across`, Gaussians that `out` contains are left out of W F; otherwise `out` contains all Gaussians.
    Features and `out` are flat, with `width` channels per row.
    """
    past = first + len(out) // (3 * width)
    for p in range(len(indptr) - 1):
        begin, end = indptr[p], indptr[p + 1]
        own_begin = columns_below(first, begin, end, indices)
        own_end = columns_below(past, own_begin, end, indices)
        if own_begin == own_end or not valid[p, level]:
            continue
        for c in range(level * width, last * width, WIDTH):
            total = lanes(np.float32(0))
            for k in range(begin, own_begin) if across else range(own_begin, own_end):
                total = plus(total, lanes(data[k]), load(features, np.int64(indices[k]) * 3 * width + c))
            for k in range(own_end, end if across else own_end):
                total = plus(total, lanes(data[k]), load(features, np.int64(indices[k]) * 3 * width + c))
            for k in range(own_begin, own_end):
                to = (indices[k] - first) * 3 * width + c
                store(out, to, plus(load(out, to), lanes(data[k]), total))


@compiled
def mask_means(first, last, indptr, indices, data, level_of, features, out):
    for m in range(first, last):
        level = level_of[m] - 1
        for k in range(indptr[m], indptr[m + 1]):
            g, weight = indices[k], data[k]
            for c in range(out.shape[1]):
                out[m, c] += weight * features[g, level, c]


@compiled
def wide_mask_means(first, last, indptr, indices, data, level_of, features, width, out):
    """Compute `mask_means` for flat features and `out`, with `width` channels per row."""
    num_gaussians = len(features) // (3 * width)
    at = indptr[first:last].copy()
    for begin in range(0, num_gaussians, BLOCK):
        for m in range(first, last):
            some = at[m - first]
            stop = at[m - first] = columns_below(begin + BLOCK, some, indptr[m + 1], indices)
            for c in range(0, width if some < stop else 0, WIDTH):
                mean = (level_of[m] - 1) * width + c
                total = load(out, m * width + c)
                for k in range(some, stop):
                    there = np.int64(indices[k]) * 3 * width + mean
                    total = plus(total, lanes(data[k]), load(features, there))
                store(out, m * width + c, total)


@compiled
def spread_rows(begin, end, indptr, indices, data, level_of, values, width, out):
    """Add columns begin..end of A' x to `out`; values and `out` are flat, with `width` channels per row."""
    masks = len(level_of)
    at = np.empty(masks, np.int64)
    for m in range(masks):
        at[m] = indptr[m] + np.searchsorted(indices[indptr[m] : indptr[m + 1]], begin)
    for block in range(begin, end, BLOCK):
        for m in range(masks):
            some = at[m]
            stop = at[m] = columns_below(min(block + BLOCK, end), some, indptr[m + 1], indices)
            for c in range(0, width if some < stop else 0, WIDTH):
                mean = (level_of[m] - 1) * width + c
                value = load(values, m * width + c)
                for k in range(some, stop):
                    there = np.int64(indices[k]) * 3 * width + mean
                    store(out, there, plus(load(out, there), lanes(data[k]), value))


@compiled
def columns_below(limit, begin, end, indices):
    """Return the end of the columns below `limit` in a row (begin..end of the sorted `indices`)."""
    while begin < end and indices[begin] < limit:
        begin += 1
    return begin


@compiled
def gram_product(begin, end, first, indptr, indices, values, features, width, out):
    """Multiply rows begin..end of the upper triangle and their mirror images; `out` starts at row `begin`.

    Column `first` is that of row 0; columns beyond the last row are left out. Features and `out` are flat,
    with `width` padded channels per row. In a plain loop over channels, numba's code keeps sums in memory and
    checks in every pass that arrays do not overlap. Here the sums stay in registers: 62 instead of 168 ms at
    d = 16 and 6.7 million pairs.
    """
    row, origin, past = 3 * width, 3 * width * begin, first + len(indptr) - 1
    for i in range(begin, end):
        for c in range(0, width, WIDTH):
            here = i * row + c
            a, b, d = load(features, here), load(features, here + width), load(features, here + 2 * width)
            offset = here - origin
            whole, part, subpart = load(out, offset), load(out, offset + width), load(out, offset + 2 * width)
            for k in range(indptr[i], indptr[i + 1]):
                if indices[k] >= past:
                    break
                there = (np.int64(indices[k]) - first) * row + c
                u, v, w = lanes(values[k, 0]), lanes(values[k, 1]), lanes(values[k, 2])
                whole = plus(whole, u, load(features, there))
                part = plus(part, v, load(features, there + width))
                subpart = plus(subpart, w, load(features, there + 2 * width))
                if there != here:
                    other = there - origin
                    store(out, other, plus(load(out, other), u, a))
                    store(out, other + width, plus(load(out, other + width), v, b))
                    store(out, other + 2 * width, plus(load(out, other + 2 * width), w, d))
            store(out, offset, whole)
            store(out, offset + width, part)
            store(out, offset + 2 * width, subpart)


@compiled
def gram_across(begin, end, indptr, indices, values, features, out):
    """Add to `out` the products of rows begin..end of G with the features (N, 3, D) of all other rows."""
    channels = features.shape[2]
    for i in range(end):
        first = indptr[i] + np.searchsorted(indices[indptr[i] : indptr[i + 1]], begin if i < begin else end)
        for k in range(first, indptr[i + 1]):
            j = np.int64(indices[k])
            if i < begin:
                if j >= end:
                    break
                to, of = j - begin, i
            else:
                to, of = i - begin, j
            for level in range(3):
                value = values[k, level]
                for c in range(channels):
                    out[to, level, c] += value * features[of, level, c]
