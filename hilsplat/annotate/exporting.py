"""Annotations for other programs: ISAT (the labels of LERF-OVS), labelme, COCO.

Only our own format has levels and parents; the others carry them in keys of ours, which their programs ignore
or keep.
"""

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hilsplat.annotate.labels import Label, as_file
from hilsplat.scene.cameras import Cameras
from hilsplat.viewer.exports import coco_counts

Kind = Literal["hilsplat", "isat", "labelme", "coco"]
OURS = ("level", "parent", "origin")


def exported(kind: Kind, known: Mapping[str, Sequence[Label]], cameras: Cameras) -> bytes:
    """All annotations as a ZIP of a file per view, or, for COCO, as one JSON file."""
    if kind == "coco":
        return _json(_coco(known, cameras)).encode()
    write = {"hilsplat": as_file, "isat": _isat, "labelme": _labelme}[kind]
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for view, labels in known.items():
            archive.writestr(f"{Path(view).stem}.json", write(view, cameras[view].size_hw, labels))
    return held.getvalue()


def _isat(view: str, size_hw: tuple[int, int], labels: Sequence[Label]) -> str:
    """ISAT has one polygon per object; pieces of a thing share their group."""
    size = {"width": size_hw[1], "height": size_hw[0]}
    info: dict[str, object] = {
        "description": "ISAT",
        "folder": "",
        "name": view,
        **size,
        "depth": 3,
        "note": "",
    }
    objects = []
    for label in labels:
        for ring in label.polygons:
            points = np.array(ring)
            box = [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]
            area = int(label.model_copy(update={"polygons": [ring]}).mask(size_hw).sum())
            objects.append(
                {
                    "category": label.text,
                    "group": label.id,
                    "segmentation": ring,
                    "area": area,
                    "layer": float(label.level),
                    "bbox": box,
                    "iscrowd": 0,
                    "note": "",
                    **_ours(label),
                }
            )
    return _json({"info": info, "objects": objects})


def _labelme(view: str, size_hw: tuple[int, int], labels: Sequence[Label]) -> str:
    shapes = [
        {
            "label": label.text,
            "points": ring,
            "group_id": label.id,
            "shape_type": "polygon",
            "flags": {},
            **_ours(label),
        }
        for label in labels
        for ring in label.polygons
    ]
    size = {"imageHeight": size_hw[0], "imageWidth": size_hw[1]}
    return _json(
        {"version": "5.5.0", "flags": {}, "shapes": shapes, "imagePath": view, "imageData": None, **size}
    )


def _coco(known: Mapping[str, Sequence[Label]], cameras: Cameras) -> dict[str, Any]:
    """Regions as run lengths, because COCO fills polygons otherwise than we do."""
    texts = sorted({label.text for labels in known.values() for label in labels})
    content: dict[str, Any] = {
        "info": {"description": "annotations by hilsplat"},
        "images": [],
        "categories": [{"id": 1 + number, "name": text} for number, text in enumerate(texts)],
        "annotations": [],
    }
    for number, (view, labels) in enumerate(known.items()):
        height, width = cameras[view].size_hw
        content["images"].append({"id": number, "file_name": view, "height": height, "width": width})
        for label in labels:
            mask = label.mask((height, width))
            rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            box = (columns[0], rows[0], np.ptp(columns) + 1, np.ptp(rows) + 1)
            content["annotations"].append(
                {
                    "id": len(content["annotations"]) + 1,
                    "image_id": number,
                    "category_id": 1 + texts.index(label.text),
                    "iscrowd": 0,
                    "area": int(mask.sum()),
                    "bbox": [int(side) for side in box],
                    "segmentation": {"size": [height, width], "counts": coco_counts(mask)},
                    "thing": label.id,
                    **_ours(label),
                }
            )
    return content


def _ours(label: Label) -> dict[str, object]:
    return {name: getattr(label, name) for name in OURS}


def _json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)
