"""Annotations for other programs: ISAT (the labels of LERF-OVS), labelme, COCO.

In these formats, levels and parents are extra keys, which other programs ignore or keep.
"""

import io
import json
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hilsplat.annotate.labels import Label, as_file, known_labels, traced
from hilsplat.base.artifacts import atomic_folder, write_text
from hilsplat.base.errors import SceneError
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.web.coco import coco_content, coco_region

Kind = Literal["hilsplat", "isat", "labelme", "coco"]
OURS = ("level", "parent", "origin")


def exported(kind: Kind, known: Mapping[str, Sequence[Label]], cameras: Cameras) -> bytes:
    """Return all annotations as a ZIP with one file per view, or, for COCO, as one JSON file."""
    if kind == "coco":
        return _json(_coco(known, cameras)).encode()
    write = {"hilsplat": as_file, "isat": _isat, "labelme": _labelme}[kind]
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for view, labels in known.items():
            archive.writestr(f"{Path(view).stem}.json", write(view, cameras[view].size_hw, labels))
    return held.getvalue()


def export_labels(scene: Scene, folder: Path, data_root: Path, out: Path) -> int:
    """Write a scene's annotations, or the true labels of a synthetic scene, as LERF-OVS's labels to `out`.

    `out`, such as `label/teatime`, is replaced; it gets `<view>.json` and the image of each labelled view.
    Each polygon is an object, as LangSplat's evaluation requires; it ignores the keys for levels and parents.
    Annotations are in `annotated/<dataset>/<scene>` below `data_root`. Return the number of labelled views.

    Raises:
        SceneError: the scene has no labels.
    """
    annotated, truth = data_root / "annotated" / scene.name, folder / "world" / "truth"
    views = scene.views()
    if truth.is_dir():
        known = labels_of_truth(HierarchyAnnotations.load(truth), views)
    else:
        known = known_labels(annotated, scene.cameras, views)
    if not known:
        raise SceneError(
            f"{scene.name} has no labels", expected=f"files in {annotated}", fix=f"hilsplat annotate {folder}"
        )
    with atomic_folder(out) as temporary:
        for view, labels in known.items():
            text = _isat(view, scene.cameras[view].size_hw, labels)
            write_text(temporary / f"{Path(view).stem}.json", text + "\n")
            shutil.copyfile(scene.image_path(view), temporary / view)
    return len(known)


def labels_of_truth(truth: HierarchyAnnotations, views: Sequence[str]) -> dict[str, list[Label]]:
    """Return the true labels of a synthetic scene as annotations, in views that have any."""
    known: dict[str, list[Label]] = {}
    for view in views:
        nodes = [truth.nodes[number] for number in truth.views.get(view, ())]
        labels = [
            Label(
                id=node.id + 1,
                level=node.level,
                parent=node.parent + 1 if node.parent in truth.views[view] else None,
                text=node.text,
                polygons=traced(truth.mask(view, [node.id])),
                origin="accepted",
            )
            for node in nodes
        ]
        if labels:
            known[view] = labels
    return known


def _isat(view: str, size_hw: tuple[int, int], labels: Sequence[Label]) -> str:
    """Format labels as ISAT, which has one polygon per object; pieces of a thing share their group."""
    size = {"width": size_hw[1], "height": size_hw[0]}
    info = {"description": "ISAT", "folder": "", "name": view, **size, "depth": 3, "note": ""}
    objects = []
    for label in labels:
        for ring in label.polygons:
            points = np.array(ring)
            described = {
                "category": label.text,
                "group": label.id,
                "segmentation": ring,
                "area": int(label.model_copy(update={"polygons": [ring]}).mask(size_hw).sum()),
                "layer": float(label.level),
                "bbox": [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()],
                "iscrowd": 0,
                "note": "",
            }
            objects.append({**described, **_ours(label)})
    return _json({"info": info, "objects": objects})


def _labelme(view: str, size_hw: tuple[int, int], labels: Sequence[Label]) -> str:
    shapes = []
    for label in labels:
        about = {"group_id": label.id, "shape_type": "polygon", "flags": {}, **_ours(label)}
        shapes += [{"label": label.text, "points": ring, **about} for ring in label.polygons]
    image = {"imagePath": view, "imageData": None, "imageHeight": size_hw[0], "imageWidth": size_hw[1]}
    return _json({"version": "5.5.0", "flags": {}, "shapes": shapes, **image})


def _coco(known: Mapping[str, Sequence[Label]], cameras: Cameras) -> dict[str, Any]:
    """Format labels as COCO, with run lengths, because COCO fills polygons differently than we do."""
    texts = sorted({label.text for labels in known.values() for label in labels})
    content = coco_content("annotations by hilsplat", known, cameras, texts)
    for number, (view, labels) in enumerate(known.items()):
        for label in labels:
            described = {
                "id": len(content["annotations"]) + 1,
                "image_id": number,
                "category_id": 1 + texts.index(label.text),
                **coco_region(label.mask(cameras[view].size_hw)),
                "thing": label.id,
            }
            content["annotations"].append({**described, **_ours(label)})
    return content


def _ours(label: Label) -> dict[str, object]:
    return {name: getattr(label, name) for name in OURS}


def _json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)
