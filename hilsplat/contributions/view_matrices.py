"""Compute A, A_half, S and mass of one view from its weights and masks, as defined in `stage`."""

import hashlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import scipy.sparse as sp
from jaxtyping import Int32

from hilsplat.base.compiled import compiled
from hilsplat.base.levels import LEVELS
from hilsplat.contributions.compositing import visible_mass
from hilsplat.contributions.gram_builder import SUMS, add_products, enlarged
from hilsplat.contributions.quadratic import StackedWeights
from hilsplat.segment.masks import HierarchicalMasks

MATRICES = ("A", "A_half", "S")


def label_maps(masks: HierarchicalMasks) -> Int32[np.ndarray, "P 3"]:
    """Return the row of the painted mask at each pixel and level, -1 for none."""
    return np.stack([masks.label_map(level).reshape(-1) for level in LEVELS], axis=1)


def painted_indicator(labels: Int32[np.ndarray, "P 3"], num_masks: int, pixels: np.ndarray) -> sp.csr_matrix:
    """Return B: one row per mask, with ones at those of the given pixels that show it (float64)."""
    pixel, level = np.nonzero((labels >= 0) & pixels[:, None])
    ones = np.ones(len(pixel))
    return sp.csr_matrix((ones, (labels[pixel, level], pixel)), shape=(num_masks, len(labels)))


def random_half(view: str, pixels: int) -> np.ndarray:
    """Select each pixel with probability 1/2, seeded by the view's name."""
    seed = int.from_bytes(hashlib.sha256(view.encode()).digest()[:8], "little")
    return np.random.default_rng(seed).random(pixels) < 0.5


def _mask_sums(
    weights: sp.csr_matrix,
    masks: HierarchicalMasks,
    labels: Int32[np.ndarray, "P 3"],
    half: np.ndarray,
    threads: int,
) -> tuple[np.ndarray, ...]:
    """Return the output of `summed_masks` for all masks; it does not depend on `threads`."""
    total_px = np.concatenate([[0], np.cumsum(masks.area_px)])
    shares = np.linspace(0, total_px[-1], max(1, threads) + 1)[1:-1]
    edges = [0, *np.searchsorted(total_px, shares).tolist(), len(masks)]
    pixels = labels, half, weights.indptr, weights.indices, weights.data
    level_index = masks.level.astype(np.int64) - 1

    def some(first: int, last: int) -> tuple[np.ndarray, ...]:
        return summed_masks(first, last, masks.runs, masks.offsets, level_index, *pixels, weights.shape[1])

    with ThreadPoolExecutor(max(1, threads)) as pool:
        counts, starts, columns, values = zip(*pool.map(some, edges[:-1], edges[1:]), strict=True)
    sizes = np.concatenate([np.diff(each) for each in starts])
    merged = (np.concatenate(each) for each in (counts, columns, values))
    return np.concatenate([[0], np.cumsum(sizes)]), *merged


@compiled
def summed_masks(first, last, runs, offsets, level_index, labels, half, indptr, indices, data, num_gaussians):
    """Sum weights over masks first..last, and count the summed pixels.

    Args:
        labels: output of `label_maps`.
        half: whether a pixel is in the random half.
        indptr, indices, data: W; pixels without weights are ignored.

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


def view_contributions(
    view: str, weights: sp.csr_matrix, masks: HierarchicalMasks, threads: int = 1
) -> dict[str, np.ndarray]:
    """Return all matrices of one view except W as plain arrays (`A_data`, `A_indices`, `A_indptr`, ...).

    Args:
        view: name of the view, which seeds the random halves.
        weights: output of `normalised_weights`.
        threads: the result does not depend on it.
    """
    labels, half = label_maps(masks), random_half(view, weights.shape[0])
    starts, counts, columns, sums = _mask_sums(weights, masks, labels, half, threads)
    pixels, half_pixels = counts.T
    means = [1.0 / np.maximum(n, 1) for n in (pixels, half_pixels)]
    arrays = {"pixels": pixels.copy(), "half_pixels": half_pixels.copy(), "mass": visible_mass(weights)}
    scales = {"S": np.ones(len(masks)), "A": means[0], "A_half": means[1]}
    for index, (name, scale) in enumerate(scales.items()):
        present = sums[:, index] > 0
        scaled = np.repeat(scale, np.diff(starts)) * sums[:, index]
        arrays[f"{name}_data"] = scaled[present].astype(np.float32)
        arrays[f"{name}_indices"] = columns[present]
        arrays[f"{name}_indptr"] = np.concatenate([[0], np.cumsum(present)])[starts]
    return arrays


def labelled_rows(weights: sp.csr_matrix, labels: Int32[np.ndarray, "P 3"]) -> StackedWeights:
    """Return the rows of W with Gaussians and a mask at some level, stored in the memory of `weights`."""
    sizes = np.diff(weights.indptr)
    valid = (labels >= 0) & (sizes > 0)[:, None]
    rows = np.flatnonzero(valid.any(axis=1))
    kept = _move_to_front(rows, weights.indptr, weights.indices, weights.data)
    indptr = np.concatenate([[0], np.cumsum(sizes[rows])])
    arrays = (weights.data[:kept], weights.indices[:kept], indptr.astype(weights.indptr.dtype))
    matrix = sp.csr_matrix(arrays, shape=(len(rows), weights.shape[1]), copy=False)
    return StackedWeights(matrix, valid[rows])


@compiled
def _move_to_front(rows, indptr, indices, data):
    done = 0
    for row in rows:
        for k in range(indptr[row], indptr[row + 1]):
            indices[done], data[done] = indices[k], data[k]
            done += 1
    return done
