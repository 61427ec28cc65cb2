"""Annotations in the formats of other programs: ISAT (the labels of LERF-OVS), labelme and COCO.

In these formats, levels and parents are extra keys, which other programs ignore or keep. Objects without
these keys are imported as wholes.
"""

import io
import json
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool

from hilsplat.annotate.labels import Label, as_file, known_labels, labels_of, traced, whole_pixels
from hilsplat.base.artifacts import atomic_folder, parse_json, write_text
from hilsplat.base.errors import SceneError
from hilsplat.datasets.images.isat import fill_polygons, parse_isat, trace_polygons
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.web.coco import coco_content, coco_region

Kind = Literal["hilsplat", "isat", "labelme", "coco"]
OURS = {"level", "parent", "origin"}
"""Our extra keys in the other formats."""


def exported(kind: Kind, known: Mapping[str, Sequence[Label]], cameras: Cameras) -> bytes:
    """Return all annotations as a ZIP with one file per view or, for COCO, as one JSON file."""
    if kind == "coco":
        return json.dumps(_coco(known, cameras), ensure_ascii=False).encode()
    write = {"hilsplat": as_file, "isat": _isat, "labelme": _labelme}[kind]
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for view, labels in known.items():
            archive.writestr(f"{Path(view).stem}.json", write(view, cameras[view].size_hw, labels))
    return held.getvalue()


def export_labels(scene: Scene, folder: Path, data_root: Path, out: Path) -> int:
    """Write a scene's annotations, or a synthetic scene's ground truth, in the layout of LERF-OVS's labels.

    The folder `out`, such as `label/teatime`, is replaced. It contains `<view>.json` and the image of each
    labelled view. Each polygon is an object, as LangSplat's evaluation requires; that evaluation ignores the
    keys for levels and parents. Annotations are read from `annotated/<dataset>/<scene>` below `data_root`.
    Return the number of labelled views.

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
    """Return a synthetic scene's ground-truth labels as annotations, for views that have labels."""
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
    """Format labels as ISAT, one polygon per entry; all pieces of a labelled object have the same group."""
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
                "area": int(fill_polygons([ring], size_hw).sum()),
                "layer": float(label.level),
                "bbox": [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()],
                "iscrowd": 0,
                "note": "",
            }
            objects.append({**described, **label.model_dump(include=OURS)})
    return json.dumps({"info": info, "objects": objects}, ensure_ascii=False)


def _labelme(view: str, size_hw: tuple[int, int], labels: Sequence[Label]) -> str:
    shapes = []
    for label in labels:
        own = label.model_dump(include=OURS)
        about = {"group_id": label.id, "shape_type": "polygon", "flags": {}, **own}
        shapes += [{"label": label.text, "points": ring, **about} for ring in label.polygons]
    image = {"imagePath": view, "imageData": None, "imageHeight": size_hw[0], "imageWidth": size_hw[1]}
    return json.dumps({"version": "5.5.0", "flags": {}, "shapes": shapes, **image}, ensure_ascii=False)


def _coco(known: Mapping[str, Sequence[Label]], cameras: Cameras) -> dict[str, Any]:
    """Format labels as COCO, with run lengths because COCO fills polygons differently."""
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
            content["annotations"].append({**described, **label.model_dump(include=OURS)})
    return content


# -- import ---------------------------------------------------------------------------------------


def imported(name: str, text: str, cameras: Cameras) -> dict[str, list[Label]]:
    """Return the annotations in a file, which may have any of the four formats, by view.

    Objects are numbered from 1 unless the file has ids. Without a photograph's name, the file's name counts.

    Raises:
        SceneError: the format is unknown, or the file does not fit the scene.
    """
    readers = {"shapes": _from_labelme, "annotations": _from_coco, "objects": _from_isat}
    try:
        content = parse_json(text)
        for key, read in readers.items():
            if isinstance(content, dict) and isinstance(content.get(key), list):
                return read(name, content, cameras)
    except (TypeError, ValueError, KeyError, AttributeError, OverflowError) as error:
        # Any value may be invalid or have an unexpected type: a list as an id, an infinite number.
        raise SceneError(f"{name} cannot be read: {error}", expected="a complete JSON file") from error
    raise SceneError(
        f"{name} has an unknown format",
        expected="the key 'objects' (ISAT, LERF-OVS, hilsplat), 'shapes' (labelme) or 'annotations' (COCO)",
        found=f"keys {', '.join(content)}" if isinstance(content, dict) else type(content).__name__,
    )


Piece = tuple[str, Any, np.ndarray, Mapping[str, Any]]
"""Text, identifier of the object (or None), vertices, and the keys in the file."""


def _joined(name: str, pieces: Sequence[Piece]) -> list[Label]:
    """Join pieces into one label per object; pieces without an identifier are separate objects."""
    things: dict[Any, list[Piece]] = {}
    for row, piece in enumerate(pieces):
        things.setdefault((piece[0], piece[1]) if piece[1] is not None else row, []).append(piece)
    own = [same[0][1] for same in things.values()]
    is_id = all(type(number) is int and number > 0 for number in own) and len(set(own)) == len(own)
    numbers = own if is_id else range(1, 1 + len(own))
    return [_label(name, number, same, is_id) for number, same in zip(numbers, things.values(), strict=True)]


def _label(name: str, number: int, pieces: Sequence[Piece], has_ids: bool) -> Label:
    text, _, _, keys = pieces[0]
    return Label.read(
        name,
        id=number,
        level=keys.get("level") or 1,
        parent=keys.get("parent") if has_ids else None,
        text=text,
        polygons=[whole_pixels(piece[2]) for piece in pieces],
        origin=keys.get("origin") or "drawn",
    )


def _from_isat(name: str, content: Mapping[str, Any], cameras: Cameras) -> dict[str, list[Label]]:
    labels = parse_isat(Path(name), content)
    view = _view(name, str(content["info"].get("name") or name), cameras, *labels.size_hw)
    if labels.objects and all("id" in thing.keys for thing in labels.objects):
        return {view: labels_of(labels)}
    pieces: list[Piece] = []
    for thing in labels.objects:
        # Without our keys, groups are ignored: in LERF-OVS's files, group numbers are not unique.
        group = thing.keys.get("group") if "level" in thing.keys else None
        pieces += [(thing.category, group, polygon, thing.keys) for polygon in thing.polygons]
    return {view: _joined(name, pieces)}


def _from_labelme(name: str, content: Mapping[str, Any], cameras: Cameras) -> dict[str, list[Label]]:
    image = str(content.get("imagePath") or name)
    view = _view(name, image, cameras, content.get("imageHeight"), content.get("imageWidth"))
    pieces: list[Piece] = []
    for row, shape in enumerate(content["shapes"]):
        where = f"{name}, shape {row}"
        try:
            points = np.array(shape["points"], np.float64).reshape(-1, 2)
            kind, text = shape.get("shape_type", "polygon"), str(shape["label"])
        except (TypeError, KeyError, ValueError) as error:
            raise SceneError(f"{where} cannot be read: {error!r}", expected="label and points") from error
        if kind == "rectangle" and len(points) == 2:
            (x0, y0), (x1, y1) = points
            points = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        elif kind != "polygon":
            raise SceneError(
                f"{where} ({text}) is a {kind}", expected="polygon or rectangle", fix="redraw it"
            )
        pieces.append((text, shape.get("group_id"), points, shape))
    return {view: _joined(name, pieces)}


def _from_coco(name: str, content: Mapping[str, Any], cameras: Cameras) -> dict[str, list[Label]]:
    try:
        texts = {each["id"]: str(each["name"]) for each in content["categories"]}
        images = {each["id"]: each for each in content["images"]}
        views = {
            number: _view(name, str(each["file_name"]), cameras, each.get("height"), each.get("width"))
            for number, each in images.items()
        }
        found: dict[str, list[Label]] = {view: [] for view in views.values()}
        for row, each in enumerate(content["annotations"]):
            view = views[each["image_id"]]
            where, size_hw = f"{name}, annotation {row}", cameras[view].size_hw
            polygons = _coco_polygons(where, each["segmentation"], size_hw)
            number, has_ids = each.get("thing", 1 + len(found[view])), "thing" in each
            pieces = [(texts[each["category_id"]], None, polygon, each) for polygon in polygons]
            if pieces:
                found[view].append(_label(name, number, pieces, has_ids))
    except (TypeError, KeyError) as error:
        raise SceneError(f"{name} is not a COCO file: {error!r} is missing or has the wrong type") from error
    return {view: labels for view, labels in found.items() if labels}


def _coco_polygons(where: str, value: Any, size_hw: tuple[int, int]) -> list[np.ndarray]:
    """Read polygons from flat lists x1, y1, x2, ..., or from run lengths, plain or compressed."""
    if isinstance(value, list):
        return [np.array(flat, np.float64).reshape(-1, 2) for flat in value]
    counts = value["counts"]
    if tuple(value["size"]) != tuple(size_hw):
        raise SceneError(
            f"{where} does not match the size of its photograph",
            expected=f"size {list(size_hw)}",
            found=value["size"],
        )
    runs = unpacked_counts(counts) if isinstance(counts, str) else [int(count) for count in counts]
    if sum(runs) != size_hw[0] * size_hw[1] or min(runs, default=0) < 0:
        raise SceneError(f"{where}: run lengths do not match the photograph's size", found=f"{sum(runs)} px")
    values = np.arange(len(runs)) % 2 == 1  # the inverse of `web.coco.coco_counts`
    return trace_polygons(np.ascontiguousarray(np.repeat(values, runs).reshape(size_hw[::-1]).T))


def unpacked_counts(text: str) -> list[int]:
    """Decode COCO's compressed run lengths.

    Each character has five bits, low bits first; after three runs, each is relative to the run two earlier.
    """
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    return runs


def _view(name: str, image: str, cameras: Cameras, height: Any, width: Any) -> str:
    """Return the view whose photograph has the given name and size; folder and suffix are ignored."""
    stem = Path(image.replace("\\", "/")).stem
    view = next((each for each in cameras.names if Path(each).stem == stem), None)
    if view is None:
        raise SceneError(
            f"{name} does not match a photograph in this scene",
            expected=f"a name such as {cameras.names[0]}",
            found=image,
        )
    size_hw = cameras[view].size_hw
    if (height, width) != (None, None) and (height, width) != tuple(size_hw):
        raise SceneError(
            f"{name} does not match the size of its photograph",
            expected=f"{size_hw[1]} x {size_hw[0]} px (width x height), undistorted",
            found=f"{width} x {height} px",
        )
    return view


SAME_THING = 0.5
"""Minimum IoU at which two labels with the same text and level in a photograph are the same object."""


def merged(
    known: Mapping[str, Sequence[Label]],
    files: Sequence[Mapping[str, Sequence[Label]]],
    sizes_hw: Mapping[str, tuple[int, int]],
) -> tuple[dict[str, list[Label]], int, int]:
    """Add the labels in files to the scene's labels.

    Ids are compared only among objects with the same text and level, because shapes without ids are numbered
    from 1 in every photograph. Among the scene's objects with the same text and level, a label is matched to
    an object that it overlaps. If there is none, it is matched to one with the same id, and otherwise to one
    without a label in the photograph. A label without a match is a new object.

    Returns:
        all labels of each changed photograph; the number of labels that are new or have a new region; and the
        number of labels that already existed.
    """
    views = {view: list(labels) for view, labels in known.items()}
    things = {label.id: _kind(label) for labels in views.values() for label in labels}
    changed: set[str] = set()
    added = same = 0
    for found in files:
        for view, labels in found.items():
            here = views.setdefault(view, [])
            number_of: dict[int, int] = {}
            for label in sorted(labels, key=lambda label: label.level):
                parent = number_of.get(label.parent) if label.parent is not None else None
                mask = label.mask(sizes_hw[view])
                row = _row_of(label, mask, here, sizes_hw[view])
                number = here[row].id if row is not None else _number(label, here, things)
                number_of[label.id], things[number] = number, _kind(label)
                label = label.model_copy(update={"id": number, "parent": parent})
                if row is None:
                    here.append(label)
                elif np.array_equal(mask, here[row].mask(sizes_hw[view])):
                    same += 1
                    continue
                else:
                    here[row] = label
                added += 1
                changed.add(view)
    return {view: views[view] for view in views if view in changed}, added, same


def _kind(label: Label) -> tuple[str, int]:
    return label.text.casefold(), label.level


def _row_of(
    label: Label, mask: Bool[np.ndarray, "H W"], here: Sequence[Label], size_hw: tuple[int, int]
) -> int | None:
    """Return the row of the photograph's label of the same object; None if there is no such label."""
    for row, other in enumerate(here):
        if _kind(other) == _kind(label):
            region = other.mask(size_hw)
            if (mask & region).sum() >= SAME_THING * max(1, (mask | region).sum()):
                return row
    return None


def _number(label: Label, here: Sequence[Label], things: Mapping[int, tuple[str, int]]) -> int:
    """Return the id for a label that overlaps no label of its kind in the photograph."""
    taken = {other.id for other in here}
    alike = [number for number, kind in things.items() if kind == _kind(label) and number not in taken]
    if label.id in alike or label.id not in things:
        return label.id
    return min(alike, default=1 + max(things))
