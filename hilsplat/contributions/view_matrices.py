"""The matrices of one view: masks by Gaussians, and the rows of W for pixels inside a mask."""

import hashlib

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Float64, Int32, Int64

from cpusplat.threads import over_edges
from hilsplat.base.levels import LEVELS
from hilsplat.contributions.compositing import visible_mass
from hilsplat.contributions.kernels import move_to_front, summed_masks
from hilsplat.contributions.quadratic import StackedWeights
from hilsplat.segment.masks import HierarchicalMasks


def label_maps(masks: HierarchicalMasks) -> Int32[np.ndarray, "P 3"]:
    """Return the row of the painted mask at each pixel and level, -1 for none."""
    return np.stack([masks.label_map(level).reshape(-1) for level in LEVELS], axis=1)


def painted_indicator(labels: Int32[np.ndarray, "P 3"], num_masks: int, pixels: np.ndarray) -> sp.csr_matrix:
    """Return B: one row per mask, with ones at the given pixels that show the mask (float64)."""
    pixel, level = np.nonzero((labels >= 0) & pixels[:, None])
    ones = np.ones(len(pixel))
    return sp.csr_matrix((ones, (labels[pixel, level], pixel)), shape=(num_masks, len(labels)))


def random_half(view: str, pixels: int) -> np.ndarray:
    """Select each pixel with probability 1/2, seeded by the view's name."""
    seed = int.from_bytes(hashlib.sha256(view.encode()).digest()[:8], "little")
    return np.random.default_rng(seed).random(pixels) < 0.5


def view_contributions(
    view: str, weights: sp.csr_matrix, masks: HierarchicalMasks, threads: int = 1
) -> dict[str, np.ndarray]:
    """Return all matrices of one view except W as plain arrays (`A_data`, `A_indices`, `A_indptr`, ...).

    `mass` has one row: the Gaussians that the view shows at all.
    The view's name seeds the random halves; `weights` are normalised. `threads` does not affect the result.
    """
    total_px = np.concatenate([[0], np.cumsum(masks.area_px)])
    shares = np.linspace(0, total_px[-1], max(1, threads) + 1)[1:-1]
    edges = [0, *np.searchsorted(total_px, shares).tolist(), len(masks)]
    pixels = label_maps(masks), random_half(view, weights.shape[0])
    runs = masks.runs, masks.offsets, masks.level
    W = weights.indptr, weights.indices, weights.data, weights.shape[1]
    parts = over_edges(summed_masks, edges, threads, *runs, *pixels, *W)
    counts, sizes, columns, sums = (np.concatenate(part) for part in zip(*parts, strict=True))
    painted, in_half = counts.T
    return scaled_matrices(painted, in_half, sizes, columns, sums, visible_mass(weights))


def scaled_matrices(
    painted: Int64[np.ndarray, " M"],
    in_half: Int64[np.ndarray, " M"],
    sizes: Int64[np.ndarray, " M"],
    columns: Int32[np.ndarray, " E"],
    sums: Float64[np.ndarray, "E 3"],
    mass: Float32[np.ndarray, " N"],
) -> dict[str, np.ndarray]:
    """Return the matrices of `view_contributions`, given the sums of weights of each mask.

    Args:
        painted, in_half: covered pixels of each painted mask, and those in the random half.
        sizes: number of Gaussians that each mask shows; `columns` and `sums` list them mask by mask.
        sums: weight of a Gaussian in the raw mask, in the painted pixels, and in those in the half.
        mass: visible mass of each Gaussian.
    """
    starts = np.concatenate([[0], np.cumsum(sizes)])
    arrays = {"pixels": painted.copy(), "half_pixels": in_half.copy()}
    seen = np.flatnonzero(mass)
    arrays |= {"mass_data": mass[seen], "mass_indices": seen, "mass_indptr": np.array([0, len(seen)])}
    areas = {"S": np.ones(len(sizes)), "A": np.maximum(painted, 1), "A_half": np.maximum(in_half, 1)}
    for index, (name, area) in enumerate(areas.items()):
        present = sums[:, index] > 0
        scaled = np.repeat(1.0 / area, sizes) * sums[:, index]
        arrays[f"{name}_data"] = scaled[present].astype(np.float32)
        arrays[f"{name}_indices"] = columns[present]
        arrays[f"{name}_indptr"] = np.concatenate([[0], np.cumsum(present)])[starts]
    return arrays


def labelled_rows(weights: sp.csr_matrix, labels: Int32[np.ndarray, "P 3"]) -> StackedWeights:
    """Return the rows of W that have Gaussians and a mask at any level; the memory of `weights` is reused."""
    sizes = np.diff(weights.indptr)
    valid = (labels >= 0) & (sizes > 0)[:, None]
    rows = np.flatnonzero(valid.any(axis=1))
    num_entries = move_to_front(rows, weights.indptr, weights.indices, weights.data)
    indptr = np.concatenate([[0], np.cumsum(sizes[rows])])
    arrays = (weights.data[:num_entries], weights.indices[:num_entries], indptr.astype(weights.indptr.dtype))
    matrix = sp.csr_matrix(arrays, shape=(len(rows), weights.shape[1]), copy=False)
    return StackedWeights(matrix, valid[rows])
