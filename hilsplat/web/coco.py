"""Masks in COCO's format, which both pages export."""

from typing import Any

import numpy as np
from jaxtyping import Bool


def coco_region(mask: Bool[np.ndarray, "H W"]) -> dict[str, Any]:
    """Return the keys of an annotation that describe its region; run lengths instead of polygons."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    box = (columns[0], rows[0], np.ptp(columns) + 1, np.ptp(rows) + 1)
    return {
        "iscrowd": 0,
        "area": int(mask.sum()),
        "bbox": [int(side) for side in box],
        "segmentation": {"size": list(mask.shape), "counts": coco_counts(mask)},
    }


def coco_counts(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """Return COCO's uncompressed run lengths: column by column, starting with zeros."""
    flat = mask.T.ravel()
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    runs = np.diff(np.concatenate([[0], edges, [len(flat)]])).tolist()
    return [0, *runs] if flat[0] else runs
