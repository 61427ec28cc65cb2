"""Masks in COCO's format, which both pages export."""

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool

from hilsplat.scene.cameras import Cameras


def coco_content(
    description: str, views: Iterable[str], cameras: Cameras, categories: Sequence[str]
) -> dict[str, Any]:
    """Return a COCO file without annotations; views are numbered from 0, categories from 1."""
    images = []
    for number, view in enumerate(views):
        height, width = cameras[view].size_hw
        images.append({"id": number, "file_name": view, "height": height, "width": width})
    return {
        "info": {"description": description},
        "images": images,
        "categories": [{"id": number, "name": name} for number, name in enumerate(categories, 1)],
        "annotations": [],
    }


def coco_region(mask: Bool[np.ndarray, "H W"]) -> dict[str, Any]:
    """Return the annotation keys that describe a mask; the region is encoded as run lengths."""
    return {
        "iscrowd": 0,
        "area": int(mask.sum()),
        "bbox": list(cv2.boundingRect(mask.astype(np.uint8))),
        "segmentation": {"size": list(mask.shape), "counts": coco_counts(mask)},
    }


def coco_counts(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """Return COCO's uncompressed run lengths: column by column, starting with zeros."""
    flat = mask.T.ravel()
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    runs = np.diff(np.concatenate([[0], edges, [len(flat)]])).tolist()
    return [0, *runs] if flat[0] else runs
