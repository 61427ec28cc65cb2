"""Compiled loops over decoder logits; sequential, so results do not depend on the number of threads."""

from typing import no_type_check

import numpy as np

from hilsplat.base.compiled import compiled


@compiled
@no_type_check
def quantise_logits(logits, per_unit, upper, lower, valid_h, valid_w):
    """Quantise logits (K, h, w), and compute each mask's box and the areas for its stability.

    Args:
        per_unit: steps per unit of logit.
        upper, lower: the two stability thresholds, whole steps.
        valid_h, valid_w: rows and columns of the image.

    Returns:
        steps int8 (K, h, w) in -127..127; pixels of the image above `upper` and above `lower`;
        box (xyxy, end exclusive) of all pixels above 0, empty if there are none.
    """
    number, height, width = logits.shape
    steps = np.empty((number, height, width), np.int8)
    above = np.zeros((2, number), np.int64)
    boxes = np.zeros((number, 4), np.int32)
    for k in range(number):
        x0, y0, x1, y1 = width, height, 0, 0
        small, large = 0, 0
        for y in range(height):
            most = np.int8(-127)
            for x in range(width):
                value = np.rint(logits[k, y, x] * per_unit)
                value = min(max(value, np.float32(-127)), np.float32(127))
                step = np.int8(value)
                steps[k, y, x] = step
                most = max(most, step)
            if y < valid_h:
                for x in range(valid_w):
                    small += steps[k, y, x] > upper
                    large += steps[k, y, x] > lower
            if most > 0:
                left = 0
                while steps[k, y, left] <= 0:
                    left += 1
                right = width
                while steps[k, y, right - 1] <= 0:
                    right -= 1
                x0, x1, y0, y1 = min(x0, left), max(x1, right), min(y0, y), y + 1
        above[0, k], above[1, k] = small, large
        if y1 > 0:
            boxes[k] = x0, y0, x1, y1
    return steps, above[0], above[1], boxes


@compiled
@no_type_check
def edge_windows(steps, rows, boxes, reach):
    """Extract each mask's logits near its edge, flattened to +-127 elsewhere.

    Args:
        steps: int8 or float32 (K, h, w).
        rows: masks to extract; none is empty.
        boxes: box (xyxy) of the positive pixels of every mask.
        reach: distance from a change of sign within which pixels keep their value; all others become
            127 or -127. The window is the box with this margin, clipped to the image.

    Returns:
        concatenated values of all windows, in the type of `steps`; offsets; windows (xyxy).
    """
    _, height, width = steps.shape
    windows = np.empty((len(rows), 4), np.int32)
    offsets = np.zeros(len(rows) + 1, np.int64)
    for place in range(len(rows)):
        x0, y0, x1, y1 = boxes[rows[place]]
        x0, y0 = max(x0 - reach, 0), max(y0 - reach, 0)
        x1, y1 = min(x1 + reach, width), min(y1 + reach, height)
        windows[place] = x0, y0, x1, y1
        offsets[place + 1] = offsets[place] + (y1 - y0) * (x1 - x0)
    out = np.empty(offsets[-1], steps.dtype)
    for place in range(len(rows)):
        mask = steps[rows[place]]
        x0, y0, x1, y1 = windows[place]
        high, wide = y1 - y0, x1 - x0
        # positive pixels among the (2 reach + 1)^2 around each pixel: sums along x, then along y
        along = np.zeros((high, wide), np.int32)
        for y in range(high):
            total = 0
            for x in range(min(reach, wide)):
                total += mask[y0 + y, x0 + x] > 0
            for x in range(wide):
                if x + reach < wide:
                    total += mask[y0 + y, x0 + x + reach] > 0
                if x - reach - 1 >= 0:
                    total -= mask[y0 + y, x0 + x - reach - 1] > 0
                along[y, x] = total
        around = np.zeros(wide, np.int32)
        for y in range(min(reach, high)):
            around += along[y]
        at = offsets[place]
        for y in range(high):
            if y + reach < high:
                around += along[y + reach]
            if y - reach - 1 >= 0:
                around -= along[y - reach - 1]
            rows_seen = min(y0 + y + reach + 1, height) - max(y0 + y - reach, 0)
            for x in range(wide):
                seen = rows_seen * (min(x0 + x + reach + 1, width) - max(x0 + x - reach, 0))
                if around[x] == 0:
                    out[at] = -127
                elif around[x] == seen:
                    out[at] = 127
                else:
                    out[at] = mask[y0 + y, x0 + x]
                at += 1
    return out, offsets, windows
