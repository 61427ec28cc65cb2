"""Annotations of one view: text, level, parent and pixels of each object.

Each view has a file in the format of `datasets.images.hi`; an object has the same id in all views. Polygon
vertices are whole pixels, so that evaluation fills exactly the drawn region.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Bool
from pydantic import AfterValidator, Field

from hilsplat.base.artifacts import write_text
from hilsplat.base.errors import SettingsError, foreign
from hilsplat.base.levels import Level
from hilsplat.base.removal import delete
from hilsplat.datasets.images.hi import by_id, parents_of
from hilsplat.datasets.images.isat import IsatFile, Polygon, fill_polygons, read_isat, trace_polygons
from hilsplat.scene.cameras import MAX_SIDE_PX, Camera, Cameras
from hilsplat.scene.layouts import read_json_object
from hilsplat.scene.placement import ON_VIEW, of_view, placed
from hilsplat.web.file_changes import replacing, version_of
from hilsplat.web.messages import Message

Origin = Literal["drawn", "edited", "accepted", "proposed"]
Place = Annotated[int, Field(ge=-MAX_SIDE_PX, le=2 * MAX_SIDE_PX)]
Ring = Annotated[list[tuple[Place, Place]], Field(min_length=1, max_length=20_000)]
Rings = Annotated[list[Ring], Field(max_length=2000)]

REPLACED = {"id", "level", "parent", "category", "origin", "segmentation", "bbox", "area"}
"""Keys of an object that are written by us, or that are wrong for a new outline."""


def _plain_text(text: str) -> str:
    plain = " ".join(text.split())
    if not plain or not plain.isprintable():
        raise ValueError("it must contain at least one character, and all must be printable")
    return plain


class Label(Message):
    """One object in one view.

    Attributes:
        id: identifies the object in all views.
        level: 1 whole, 2 part, 3 subpart.
        parent: id of an object one level up in the same view; None if there is no parent.
        polygons: vertices in whole pixels; the region is the union of the filled polygons.
        origin: whether the label was drawn by hand, proposed from a node, mask or other view, accepted as
            proposed, or edited after it was proposed. Labels that are only proposed are not scored.
    """

    id: Annotated[int, Field(ge=1, lt=2**31)]
    level: Annotated[int, Field(ge=1, le=3)]
    parent: int | None = None
    text: Annotated[str, Field(max_length=200), AfterValidator(_plain_text)]
    polygons: Annotated[Rings, Field(min_length=1)]
    origin: Origin = "drawn"

    @staticmethod
    def read(where: str, **values: object) -> "Label":
        """Create a label from values of the file `where`; raise SceneError if one is invalid."""
        fix = "correct it in the file"
        with foreign(f"{where}: label {values['text']!r}", problem="is invalid", fix=fix):
            return Label.model_validate(values)

    def mask(self, size_hw: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
        """Return the label's region."""
        return fill_polygons(self.polygons, size_hw)


def traced(mask: Bool[np.ndarray, "H W"]) -> list[list[tuple[int, int]]]:
    """Return polygons that contain exactly the pixels of a mask."""
    return [whole_pixels(polygon) for polygon in trace_polygons(mask)]


def placed_rings(
    polygons: Sequence[Polygon], drawn_hw: tuple[int, int], camera: Camera, where: str
) -> list[list[tuple[int, int]]]:
    """Transfer polygons as `placed` does, from an image of the given size."""
    if drawn_hw == camera.size_hw:
        return [whole_pixels(polygon) for polygon in polygons]
    return traced(placed(fill_polygons(polygons, drawn_hw), camera, where))


def cut_to_parents(labels: Sequence[Label], size_hw: tuple[int, int]) -> list[Label]:
    """Cut every child to its parent, coarse to fine, so that subparts also stay inside their wholes.

    Raises:
        SettingsError: an id occurs twice, a parent is missing or not one level up, or a cut object is empty.
    """
    twice = [number for number, count in Counter(label.id for label in labels).items() if count > 1]
    if twice:
        raise SettingsError(f"id {twice[0]} occurs twice", fix="reload the page")
    by_number, parents = {label.id: label for label in labels}, {label.parent for label in labels}
    masks: dict[int, np.ndarray] = {}  # of parents only: a photograph may have 100 million pixels
    cut: dict[int, Label] = {}
    for label in sorted(labels, key=lambda label: label.level):
        mask = label.mask(size_hw)
        if not mask.any():
            raise SettingsError(f"{label.text!r} has no pixels inside the photograph", fix="draw it again")
        cut[label.id] = label
        if label.id in parents:
            masks[label.id] = mask
        if label.parent is None:
            continue
        parent = by_number.get(label.parent)
        if parent is None or parent.level != label.level - 1:
            missing = "no such thing in this photograph"
            raise SettingsError(
                f"{label.text!r} has an invalid parent",
                expected=f"a {Level(label.level - 1).label}" if label.level > 1 else "none: it is a whole",
                found=f"{parent.text!r}, a {Level(parent.level).label}" if parent else missing,
                fix="choose a different parent or level",
            )
        inside = mask & masks[parent.id]
        if not inside.any():
            raise SettingsError(
                f"{label.text!r} is entirely outside {parent.text!r}",
                fix="draw it inside, or choose a different parent",
            )
        if not np.array_equal(inside, mask):
            cut[label.id] = label.model_copy(update={"polygons": traced(inside)})
            if label.id in masks:
                masks[label.id] = inside
    return [cut[label.id] for label in labels]


def label_path(folder: Path, view: str) -> Path:
    return Path(folder) / f"{Path(view).stem}.json"


def known_labels(
    folder: Path, cameras: Cameras, views: Sequence[str], texts: dict[int, str] | None = None
) -> dict[str, list[Label]]:
    """Return the annotations of all annotated views.

    Labels drawn on a view's photograph or on a scaled copy are transferred to the view; labels outside the
    view are left out. Labels without levels (LERF-OVS) are wholes. An object in a file without ids gets the
    id of an object with the same text in other views, if any.

    Args:
        texts: the ids of wholes that an earlier call gave, with their casefolded texts, so that later calls
            give the same; updated.

    Raises:
        SceneError: a file, an id or a level is invalid.
        MisalignedArtifactError: a file's image size fits neither the camera nor the photograph.
    """
    texts = {} if texts is None else texts
    files = {view: read_isat(path) for view in views if (path := label_path(folder, view)).is_file()}
    labels: dict[str, list[Label]] = {}
    for view in sorted(files, key=lambda view: not _has_ids(files[view])):
        stored = _with_ids(files[view], texts)
        labels[view] = _labels_of(stored, cameras[view])
        for number, thing in by_id(stored).items():
            texts[number] = thing.category.casefold() if thing.keys["level"] == Level.WHOLE else ""
    return {view: labels[view] for view in views if labels.get(view)}


def _has_ids(stored: IsatFile) -> bool:
    return any("id" in thing.keys or "level" in thing.keys for thing in stored.objects)


def _with_ids(stored: IsatFile, texts: Mapping[int, str]) -> IsatFile:
    """Return a file with ids and levels; `texts` has the casefolded texts of known wholes by id."""
    if any("level" in thing.keys for thing in stored.objects):
        return stored
    has_ids, unused = _has_ids(stored), dict(texts)
    free, objects = 1 + max(texts, default=0), []
    for thing in stored.objects:
        if has_ids:
            keys = {**thing.keys, "level": 1}
        else:
            alike = [number for number, text in unused.items() if text == thing.category.casefold()]
            number = min(alike, default=free)
            free += number == free
            unused.pop(number, None)
            keys = {**thing.keys, "level": 1, "id": number}
        objects.append(replace(thing, keys=keys))
    return replace(stored, objects=tuple(objects))


def _labels_of(stored: IsatFile, camera: Camera) -> list[Label]:
    objects = by_id(stored)
    parents = parents_of(stored, objects, [])
    camera = of_view(camera) if stored.on_view else camera
    labels = []
    for number, thing in objects.items():
        polygons = placed_rings(thing.polygons, stored.size_hw, camera, f"label file {stored.path}")
        if polygons:
            label = Label.read(
                str(stored.path),
                id=number,
                level=thing.keys["level"],
                parent=parents[number],
                text=thing.category,
                polygons=polygons,
                origin=thing.keys.get("origin", "drawn"),
            )
            labels.append(label)
    return labels


def whole_pixels(points: Polygon) -> list[tuple[int, int]]:
    """Truncate vertices to whole pixels, as polygon filling does."""
    return [(int(x), int(y)) for x, y in points]


def write_labels(
    path: Path, view: str, size_hw: tuple[int, int], labels: Sequence[Label], version: str
) -> str:
    """Replace the annotations of a view and return the new version; without annotations, delete the file.

    Keys that we do not use are kept. A file that was drawn at another size or has no ids is kept as a whole
    under the key `original`, because it may contain regions outside the view.

    Raises:
        SceneError: the present file is invalid.
        StaleFileError: the file changed since `version` was read.
    """
    with replacing(path, version, f"the annotations of {view}") as path:
        content, keys = _kept(path, size_hw) if path.is_file() else ({}, {})
        if labels or content.keys() - {"info"}:
            write_text(path, as_file(view, size_hw, labels, content, keys))
        else:
            delete(path, r".+\.json")
        return version_of(path)


def _kept(path: Path, size_hw: tuple[int, int]) -> tuple[dict[str, Any], dict[int, dict[str, Any]]]:
    """Return what stays of a file that is rewritten: keys of the file, and keys of its objects by id."""
    stored, content = read_isat(path), read_json_object(path, "restore the file")
    kept = {key: value for key, value in content.items() if key != "objects"}
    if stored.objects and (stored.size_hw != size_hw or not _has_ids(stored)):
        return {**kept, "original": content}, {}
    objects = by_id(_with_ids(stored, {})).items()
    return kept, {
        number: {key: value for key, value in thing.keys.items() if key not in REPLACED}
        for number, thing in objects
    }


def as_file(
    view: str,
    size_hw: tuple[int, int],
    labels: Sequence[Label],
    content: Mapping[str, Any] | None = None,
    keys: Mapping[int, Mapping[str, Any]] | None = None,
) -> str:
    """Format a view's annotations in our format: one object per line, for short files and readable diffs.

    Args:
        content: more keys of the file, except `objects`; values of `info` are replaced.
        keys: more keys of objects, by id.
    """
    more = dict(content or {})
    info = {**more.pop("info", {}), "name": view, "width": size_hw[1], "height": size_hw[0], **ON_VIEW}
    objects = [
        {
            "id": label.id,
            "level": label.level,
            "parent": label.parent,
            "category": label.text,
            "origin": label.origin,
            "segmentation": label.polygons,
            **(keys or {}).get(label.id, {}),
        }
        for label in sorted(labels, key=lambda label: label.id)
    ]
    parts = [f'"info":{_compact(info)}', '"objects":[\n' + ",\n".join(map(_compact, objects)) + "\n]"]
    parts += [f"{_compact(key)}:{_compact(value)}" for key, value in more.items()]
    return "{" + ",\n".join(parts) + "}\n"


def _compact(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))
