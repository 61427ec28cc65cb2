"""Masks in COCO's format, which both pages export."""

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool
from pycocotools import mask as coco_masks

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
    """Return the annotation keys that describe a mask; the region is encoded as compressed run lengths."""
    runs = coco_masks.encode(np.asfortranarray(mask, np.uint8))
    return {
        "iscrowd": 0,
        "area": int(mask.sum()),
        "bbox": list(cv2.boundingRect(mask.astype(np.uint8))),
        "segmentation": {"size": list(mask.shape), "counts": runs["counts"].decode()},
    }
