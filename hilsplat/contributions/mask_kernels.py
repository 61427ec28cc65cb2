"""Compiled loop that sums a view's weights mask by mask, for `view_matrices.mask_sums`."""

import numpy as np

from hilsplat.base.compiled import compiled
from hilsplat.contributions.gram_kernels import SUMS, add_products, enlarged


@compiled
def summed_masks(first, last, runs, offsets, level_index, labels, half, indptr, indices, data, num_gaussians):
    """Sum weights over masks first..last, and count the summed pixels.

    Args:
        first, last: range of masks.
        runs, offsets, level_index: arrays of the masks.
        labels: row of the painted mask at each pixel and level.
        half: whether a pixel is in the random half.
        indptr, indices, data: W; pixels without weights are ignored.
        num_gaussians: N.

    Returns:
        pixel counts (masks x 2): painted ones and those in the half; row starts, columns, and sums over the
        raw mask, its painted pixels and their half (entries x 3, float64, summed in the order of the pixels).
    """
    sums, found = np.zeros(num_gaussians * SUMS), np.empty(num_gaussians, np.int32)
    counts = np.zeros((last - first, 2), np.int64)
    starts = np.zeros(last - first + 1, np.int64)
    columns, values = np.empty(1024, np.int32), np.empty((1024, 3))
    done = 0
    for m in range(first, last):
        count, pixel, level = 0, np.int64(0), level_index[m]
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
                        found[count] = np.int32(j)
                        count += 1
        found[:count] = np.sort(found[:count])
        if done + count > len(columns):
            columns, values = enlarged(columns, values, done, 2 * (done + count))
        for k in range(count):
            at = np.int64(found[k]) * SUMS
            columns[done + k] = found[k]
            values[done + k] = sums[at : at + 3]
            sums[at : at + SUMS] = 0
        done += count
        starts[m - first + 1] = done
    return counts, starts, columns[:done], values[:done]
