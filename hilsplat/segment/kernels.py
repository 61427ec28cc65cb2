"""Compiled loops that upscale decoder logits and process run lengths of masks (`masks.encode_runs`).

Loops are sequential, so results do not depend on the number of threads.
"""

import numpy as np

from cpusplat.compiled import compiled

BAND_WORDS = 2**17
"""64-bit words per band of packed masks in `shared_pixels`: 1 MiB, which fits into a core's cache."""


@compiled
def _push(out, count, length):
    """Append a run; a full buffer is doubled first."""
    if count == len(out):
        longer = np.empty(2 * len(out), np.uint32)
        longer[:count] = out
        out = longer
    out[count] = length
    return out, count + 1


@compiled
def upscaled_runs(
    logits, offsets, windows, rows, first_y, weight_y, first_x, weight_x, top, left, height, width
):
    """Upscale windows of low-resolution logits by weights along each axis, and encode the masks.

    Pixel (y, x) of a crop at (top, left) of the image is in the mask if
    `sum_ij weight_y[y, i] weight_x[x, j] low[first_y[y] + i, first_x[x] + j] > 0`, where `low` is the lowest
    logit outside the window. The weights are convex, so a pixel whose logits all have one sign has that
    sign. Only pixels near a change of sign are computed.

    Args:
        logits, offsets, windows: all windows, as in `generate.Candidates`.
        rows: windows to upscale.
        first_y, weight_y: first low-resolution row and weights of each row of the crop; the same along x.
        top, left, height, width: position of the crop in the image, and the image's size.

    Returns:
        runs and offsets (`masks.encode_runs`); an empty mask is one run.
    """
    num_y, taps_y = weight_y.shape
    num_x, taps_x = weight_x.shape
    # for each low-resolution column: the first column of the crop that reads it or a later column
    low_w = first_x[-1] + taps_x
    reader = np.searchsorted(first_x, np.arange(low_w + 1))
    out, count = np.empty(max(1024, 64 * len(rows)), np.uint32), 0
    out_offsets = np.zeros(len(rows) + 1, np.int64)
    for out_row in range(len(rows)):
        row = rows[out_row]
        x0, y0, x1, y1 = windows[row]
        wide = x1 - x0
        window = logits[offsets[row] : offsets[row + 1]].reshape(y1 - y0, wide)
        line = np.full(wide + 2 * taps_x, np.float32(-127))  # a blended row, padded with outside logits
        middle = line[taps_x : taps_x + wide]
        origin = x0 - taps_x  # low-resolution column of line[0]
        # windows may extend into the padding beside the image, which no pixel of the crop reads
        begin, end = reader[min(max(0, x0 - taps_x + 1), low_w)], reader[min(x1, low_w)]
        inside, last, last_end = False, 0, 0
        for y in range(num_y):
            base = (top + y) * width + left
            low = first_y[y]
            if low >= y1 or low + taps_y <= y0 or begin >= end:
                continue
            if inside and not (begin == 0 and left == 0 and last_end == base):
                out, count = _push(out, count, last_end - last)
                last, inside = last_end, False
            middle[:] = np.float32(0)
            for tap in range(taps_y):
                weight = weight_y[y, tap]
                source = low + tap - y0
                if weight == 0:
                    continue
                if source < 0 or source >= y1 - y0:
                    middle -= np.float32(127) * weight
                else:
                    for x in range(wide):
                        middle[x] += weight * np.float32(window[source, x])
            sign, x = False, begin
            for at in range(1, len(line) + 1):
                ends = at == len(line)
                if not ends and (line[at] > 0) == sign:
                    continue
                # pixels before the first that reads line[at] keep the sign; later pixels are computed
                # as long as they also read line[at - 1]
                stop = end if ends else min(end, reader[min(max(0, origin + at), low_w)])
                mixed = stop if ends else min(stop, reader[min(max(0, origin + at - taps_x + 1), low_w)])
                mixed = max(x, mixed)
                if mixed > x and sign != inside:
                    out, count = _push(out, count, base + x - last)
                    last, inside = base + x, sign
                for column in range(mixed, stop):
                    total = np.float32(0)
                    for tap in range(taps_x):
                        total += weight_x[column, tap] * line[first_x[column] + tap - origin]
                    if (total > 0) != inside:
                        out, count = _push(out, count, base + column - last)
                        last, inside = base + column, not inside
                x = max(x, stop)
                sign = not sign
            last_end = base + end
            if inside and not (end == num_x and left + num_x == width):
                out, count = _push(out, count, last_end - last)
                last, inside = last_end, False
        if inside:
            out, count = _push(out, count, last_end - last)
            last, inside = last_end, False
        if last < height * width:
            out, count = _push(out, count, height * width - last)
        out_offsets[out_row + 1] = count
    return out[:count].copy(), out_offsets


@compiled
def areas_and_boxes(runs, offsets, width):
    """Return the area and box (xyxy, end exclusive) of each run-length encoded mask; 0 for empty masks."""
    number = len(offsets) - 1
    area, boxes = np.zeros(number, np.int64), np.zeros((number, 4), np.int32)
    for k in range(number):
        x0, y0, x1, y1 = width, -1, 0, 0
        at = np.int64(0)
        for run in range(offsets[k], offsets[k + 1]):
            stop = at + runs[run]
            if (run - offsets[k]) % 2 == 1 and stop > at:
                area[k] += stop - at
                row, last_row = at // width, (stop - 1) // width
                if y0 < 0:
                    y0 = row
                y1 = last_row + 1
                if row == last_row:
                    x0, x1 = min(x0, at - row * width), max(x1, stop - row * width)
                else:
                    x0, x1 = 0, width
            at = stop
        if y0 >= 0:
            boxes[k] = x0, y0, x1, y1
    return area, boxes


@compiled
def _root(parent, node):
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@compiled
def _region_areas(row, start, stop, value, of, parent, area):
    """Find the 8-connected regions of segments whose value is `of`: roots in `parent`, areas at the roots."""
    number = len(row)
    previous = 0  # first segment of the row above
    first = 0  # first segment of this row
    parent[:] = np.arange(number)
    area[:] = 0
    for k in range(number):
        if k > 0 and row[k] != row[k - 1]:
            previous, first = first, k
        if value[k] != of:
            continue
        if k > first and value[k - 1] == of:
            parent[_root(parent, k)] = _root(parent, k - 1)
        if first == 0:
            continue
        at = previous
        while at < first and stop[at] < start[k]:
            at += 1
        previous = at
        while at < first and start[at] <= stop[k]:
            if value[at] == of:
                a, b = _root(parent, at), _root(parent, k)
                if a != b:
                    parent[max(a, b)] = min(a, b)
            at += 1
    for k in range(number):
        if value[k] == of:
            area[_root(parent, k)] += stop[k] - start[k]


@compiled
def cleaned_runs(runs, offsets, width, min_area):
    """Fill holes and drop islands (8-connected) smaller than `min_area`, but keep the largest island.

    Returns runs and offsets of the result, and which masks changed.
    """
    number = len(offsets) - 1
    out, count = np.empty(max(1024, len(runs)), np.uint32), 0
    out_offsets = np.zeros(number + 1, np.int64)
    changed = np.zeros(number, np.bool_)
    for k in range(number):
        mine = runs[offsets[k] : offsets[k + 1]]
        size = np.int64(mine.sum())
        most = len(mine) + size // width + 2
        row, start, stop = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
        value = np.empty(most, np.bool_)
        segments = 0
        at = np.int64(0)
        for run in range(len(mine)):  # split runs at the ends of rows
            end = at + mine[run]
            while at < end:
                line = at // width
                cut = min(end, (line + 1) * width)
                row[segments], start[segments], stop[segments] = line, at - line * width, cut - line * width
                value[segments] = run % 2 == 1
                segments += 1
                at = cut
        row, start, stop, value = row[:segments], start[:segments], stop[:segments], value[:segments]
        parent, area = np.empty(segments, np.int64), np.empty(segments, np.int64)
        _region_areas(row, start, stop, value, False, parent, area)
        filled = value.copy()
        for segment in range(segments):
            if not value[segment] and area[_root(parent, segment)] < min_area:
                filled[segment] = True
                changed[k] = True
        _region_areas(row, start, stop, filled, True, parent, area)
        largest = area.argmax()
        last, now = np.int64(0), False
        for segment in range(segments):
            keep = filled[segment]
            if keep:
                root = _root(parent, segment)
                if area[root] < min_area and root != largest:
                    keep = False
                    changed[k] = True
            if keep != now:
                border = row[segment] * width + start[segment]
                out, count = _push(out, count, border - last)
                last, now = border, keep
        if last < size:
            out, count = _push(out, count, size - last)
        out_offsets[k + 1] = count
    return out[:count].copy(), out_offsets, changed


@compiled
def _bits_set(word):
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@compiled
def _set_bits(words, start, stop):
    """Set bits start..stop-1 of a row of 64-bit words."""
    full = np.uint64(0xFFFFFFFFFFFFFFFF)
    first, last = start >> 6, (stop - 1) >> 6
    head = full << np.uint64(start & 63)
    tail = full >> np.uint64(63 - ((stop - 1) & 63))
    if first == last:
        words[first] |= head & tail
        return
    words[first] |= head
    for word in range(first + 1, last):
        words[word] = full
    words[last] |= tail


@compiled
def shared_pixels(runs, offsets, boxes, height, width):
    """Count the pixels that each pair of masks shares, int64 (M, M), as set bits of packed masks.

    Masks are packed in bands of a few image rows; for a pair, only words and rows inside both boxes are read.
    """
    number = len(offsets) - 1
    shared = np.zeros((number, number), np.int64)
    words = (width + 63) // 64
    band = max(1, min(height, BAND_WORDS // max(1, number * words)))
    bits = np.zeros((number, band, words), np.uint64)
    run, at = offsets[:-1].copy(), np.zeros(number, np.int64)  # current run of each mask, the run's start
    active = np.empty(number, np.int64)
    for top in range(0, height, band):
        bottom = min(height, top + band)
        num_active = 0
        for k in range(number):
            if boxes[k, 1] >= bottom or boxes[k, 3] <= top:
                continue
            active[num_active] = k
            num_active += 1
            bits[k] = 0
            while run[k] < offsets[k + 1]:
                end = at[k] + runs[run[k]]
                if (run[k] - offsets[k]) % 2 == 1:
                    start, stop = max(at[k], top * width), min(end, bottom * width)
                    while start < stop:
                        line = start // width
                        cut = min(stop, (line + 1) * width)
                        _set_bits(bits[k, line - top], start - line * width, cut - line * width)
                        start = cut
                if end > bottom * width:
                    break  # continues in the next band
                at[k] = end
                run[k] += 1
        for first in range(num_active):
            i = active[first]
            for second in range(first, num_active):
                j = active[second]
                x0, x1 = max(boxes[i, 0], boxes[j, 0]), min(boxes[i, 2], boxes[j, 2])
                y0, y1 = max(boxes[i, 1], boxes[j, 1], top), min(boxes[i, 3], boxes[j, 3], bottom)
                if x0 >= x1 or y0 >= y1:
                    continue
                word0, word1 = x0 >> 6, ((x1 - 1) >> 6) + 1
                total = 0
                for y in range(y0 - top, y1 - top):
                    for word in range(word0, word1):
                        total += _bits_set(bits[i, y, word] & bits[j, y, word])
                shared[i, j] += total
    for i in range(number):
        for j in range(i):
            shared[i, j] = shared[j, i]
    return shared


@compiled
def paint_runs(runs, offsets, order, canvas):
    """Write each row number of `order` to the pixels of its mask in the flat canvas; later rows win."""
    for row in order:
        at = np.int64(0)
        for run in range(offsets[row], offsets[row + 1]):
            stop = at + runs[run]
            if (run - offsets[row]) % 2 == 1:
                canvas[at:stop] = row
            at = stop
