"""Overlap of masks with the regions of a label image."""

import numpy as np
from jaxtyping import Bool, Float32, Int, Int64


def region_ious(
    labels: Int[np.ndarray, "H W"], masks: Bool[np.ndarray, "M H W"]
) -> tuple[Int64[np.ndarray, " R"], Int64[np.ndarray, " R"], Float32[np.ndarray, "R M"]]:
    """Return the ids of a label image's regions, their areas (px) and their IoUs with every mask.

    Ids ascend. Labels are negative where there is no region; masks may overlap.
    """
    flat = labels.reshape(-1)
    ids, index = np.unique(flat, return_inverse=True)
    first = int(np.searchsorted(ids, 0))
    areas = np.bincount(index, minlength=len(ids))
    guesses = masks.reshape(len(masks), flat.size)
    shared = np.zeros((len(ids), len(masks)))
    for row, guess in enumerate(guesses):
        shared[:, row] = np.bincount(index[guess], minlength=len(ids))
    union = areas[:, None] + guesses.sum(axis=1)[None] - shared
    found = (shared / np.maximum(union, 1)).astype(np.float32)
    return ids[first:].astype(np.int64), areas[first:].astype(np.int64), found[first:]
