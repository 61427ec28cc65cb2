"""Annotations in the formats of other programs: ISAT (the labels of LERF-OVS), labelme and COCO.

In these formats, levels and parents are extra keys, which other programs ignore or keep. Objects without
these keys are imported as wholes.
"""

import base64
import io
import json
import logging
import math
import re
import shlex
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image, ImageDraw
from pycocotools import mask as coco_masks

from hilsplat.annotate.labels import Label, as_file, known_labels, placed_rings, traced
from hilsplat.base.artifacts import parse_json, write_text
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import HilsplatError, SceneError, first_line, foreign
from hilsplat.base.images import open_image
from hilsplat.datasets.generators import GENERATORS
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.datasets.images import isat
from hilsplat.datasets.images.hi import PROPOSED
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.scene.placement import ON_VIEW, is_on_view, of_view, placed, placement
from hilsplat.scene.scene import Scene
from hilsplat.scene.view_names import match_names
from hilsplat.web.coco import coco_content, coco_region

logger = logging.getLogger(__name__)

Kind = Literal["hilsplat", "isat", "labelme", "coco"]
OURS = {"level", "parent", "origin"}  # our extra keys in the other formats


def exported(kind: Kind, known: Mapping[str, Sequence[Label]], cameras: Cameras) -> bytes:
    """Return all annotations as a ZIP with one file per view or, for COCO, as one JSON file.

    Only our own format contains unaccepted proposals.
    """
    if kind != "hilsplat":
        known = _accepted(known)
    if kind == "coco":
        return json.dumps(_coco(known, cameras), ensure_ascii=False).encode()
    write = {"hilsplat": as_file, "isat": _isat, "labelme": _labelme}[kind]
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for view, labels in known.items():
            archive.writestr(f"{Path(view).stem}.json", write(view, cameras[view].size_hw, labels))
    return content.getvalue()


def _accepted(known: Mapping[str, Sequence[Label]]) -> dict[str, list[Label]]:
    """Return the labels without proposals, which other programs would take as ground truth; log how many."""
    drawn = {view: [label for label in labels if label.origin != PROPOSED] for view, labels in known.items()}
    if count := sum(len(labels) - len(drawn[view]) for view, labels in known.items()):
        logger.warning("%d unaccepted proposals are not exported; accept them with: hilsplat annotate", count)
    return {view: labels for view, labels in drawn.items() if labels}


def export_labels(scene: Scene, folder: Path, data_root: Path, out: Path) -> int:
    """Write a scene's annotations, or a synthetic scene's ground truth, in the layout of LERF-OVS's labels.

    The folder `out`, such as `label/teatime`, is replaced. It contains `<view>.json` and the image of each
    labelled view as `<view>.jpg`. Each polygon is an object, as LangSplat's evaluation requires; that
    evaluation ignores the keys for levels and parents. It reads only views named frame_<number>, and compares
    them with the rendering at position <number> - 1, so the frames must be numbered from 1 without gaps;
    rename other photographs before `hilsplat new`. Annotations are read from `annotated/<dataset>/<scene>`
    below `data_root`. Return the number of labelled views.

    Raises:
        SceneError: the scene has no labels, or only unaccepted proposals.
    """
    annotated, views = data_root / "annotated" / scene.name, scene.views()
    truths = [folder / name / "truth" for name in GENERATORS]
    if truth := next(filter(Path.is_dir, truths), None):
        known = labels_of_truth(HierarchyAnnotations.load(truth), views)
    else:
        known = _accepted(known_labels(annotated, scene.cameras, views))
    if not known:
        raise SceneError(
            f"{scene.name} has no labels",
            expected=f"drawn or accepted regions in files in {annotated}",
            fix=f"hilsplat annotate {shlex.quote(str(folder))}",
        )
    with atomic_folder(out) as temporary:
        for view, labels in known.items():
            text, stem = _isat(view, scene.cameras[view].size_hw, labels), Path(view).stem
            write_text(temporary / f"{stem}.json", text + "\n")
            Image.fromarray(scene.image(view)).save(temporary / f"{stem}.jpg", quality=95)
    return len(known)


def labels_of_truth(truth: HierarchyAnnotations, views: Sequence[str]) -> dict[str, list[Label]]:
    """Return a synthetic scene's ground-truth labels as annotations, for views that have labels."""
    return {
        view: [
            Label(
                id=node.id + 1,
                level=node.level,
                parent=node.parent + 1 if node.parent in truth.views[view] else None,
                text=node.text,
                polygons=traced(truth.mask(view, [node.id])),
                origin="accepted",
            )
            for node in (truth.nodes[number] for number in truth.views[view])
        ]
        for view in views
        if truth.views.get(view)
    }


def _isat(view: str, size_hw: tuple[int, int], labels: Sequence[Label]) -> str:
    """Format labels as ISAT, one polygon per entry; all pieces of a labelled object have the same group."""
    size = {"width": size_hw[1], "height": size_hw[0], **ON_VIEW}
    name = f"{Path(view).stem}.jpg"  # LangSplat's evaluation reads the number before ".jpg"
    info = {"description": "ISAT", "folder": "", "name": name, **size, "depth": 3, "note": ""}
    objects = []
    for label in labels:
        for ring in label.polygons:
            points = np.array(ring)
            described = {
                "category": label.text,
                "group": label.id,
                "segmentation": ring,
                "area": int(isat.fill_polygons([ring], size_hw).sum()),
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
        keys = {"group_id": label.id, "shape_type": "polygon", "flags": {}, **label.model_dump(include=OURS)}
        shapes += [{"label": label.text, "points": ring, **keys} for ring in label.polygons]
    size = {"imageHeight": size_hw[0], "imageWidth": size_hw[1], **ON_VIEW}
    image = {"imagePath": view, "imageData": None, **size}
    return json.dumps({"version": "5.5.0", "flags": {}, "shapes": shapes, **image}, ensure_ascii=False)


def _coco(known: Mapping[str, Sequence[Label]], cameras: Cameras) -> dict[str, Any]:
    """Format labels as COCO, with run lengths because COCO fills polygons differently."""
    texts = sorted({label.text for labels in known.values() for label in labels})
    content = coco_content("annotations by hilsplat", known, cameras, texts)
    content["images"] = [{**image, **ON_VIEW} for image in content["images"]]
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


MAX_INVALID = 0.5
"""Maximum share of invalid annotations in a file; if it is exceeded, the file is probably misread."""

SLACK = 0.25
"""Maximum distance of a vertex from its image, in image sides; beyond it, the stated size is wrong."""

NO_AREA = {"point", "points", "line", "linestrip"}
POLYGONS = {"polygon", "oriented_rectangle", "rotation", "quadrilateral"}
"""Shape types of labelme, and of X-AnyLabeling, which has the same format."""


Photos = Mapping[str, Mapping[str, Any]]  # entries of `registration.json`, by view


class Piece(NamedTuple):
    """A region in a file; pieces of a view with the same text and number are one object."""

    view: str
    text: str
    number: Any  # None if the piece is a separate object
    rings: list[list[tuple[int, int]]]  # in whole pixels of the view
    keys: Mapping[str, Any]  # in the file


def imported(
    name: str, text: str, cameras: Cameras, notes: list[str] | None = None, photos: Photos | None = None
) -> dict[str, list[Label]]:
    """Return the annotations in a file, which may have any of the four formats, by view.

    Each format's own rule determines a region's pixels in an image of the size that the file states. Regions
    drawn on the photograph, or on a scaled copy, are then transferred to the view. Objects are numbered from
    1 unless the file has ids. Without a photograph's name, the file's name counts.

    Args:
        notes: if annotations are left out, a sentence with their number and the reasons is appended.
        photos: their folders distinguish photographs with equal names, and drawings whose file states no
            size have theirs.

    Raises:
        HilsplatError: the format is unknown, the photograph is not in the scene, more than `MAX_INVALID` of
            the annotations are invalid, or none can be used.
    """
    readers = {"shapes": _labelme_reader, "annotations": _coco_reader, "objects": _isat_reader}
    expected = "JSON with the key 'objects' (ISAT, hilsplat), 'shapes' (labelme) or 'annotations' (COCO)"
    with foreign(name, expected=expected, fix="export the annotations as COCO"):
        content = parse_json(text)
        keys = content if isinstance(content, dict) else {}
        kind = next((key for key in readers if isinstance(keys.get(key), list)), None)
        if kind is None:
            raise ValueError(f"it has an unknown format, with the keys {', '.join(keys) or 'none'}")
        read = readers[kind](name, content, cameras, photos or {})
    pieces: dict[str, list[Piece]] = {}
    left: Counter[str] = Counter()
    errors: list[HilsplatError] = []  # of invalid annotations
    for row, entry in enumerate(content[kind]):
        try:
            with foreign(where := f"{name}, {kind[:-1]} {row}"):
                piece = read(where, entry)
        except HilsplatError as error:
            errors.append(error)
            continue
        if isinstance(piece, str):
            left[piece] += 1
        elif piece.rings:
            pieces.setdefault(piece.view, []).append(piece)
        else:
            left["without pixels in the view"] += 1
    labels = {view: joined for view, same in pieces.items() if (joined := _joined(name, same, errors))}
    total = len(content[kind])
    if len(errors) > MAX_INVALID * total or (errors and not labels):
        errors[0].add_line("invalid", f"{len(errors)} of {total} annotations in {name}")
        raise errors[0]
    if errors:
        left[f"invalid ({first_line(errors[0])})"] = len(errors)
    reasons = "; ".join(f"{count} {reason}" for reason, count in left.items())
    if left and not labels:
        raise SceneError(f"{name} has no annotation for this scene", found=f"annotations: {reasons}")
    if left and notes is not None:
        notes.append(f"{name}: {left.total()} of {total} annotations are left out: {reasons}")
    return labels


def _joined(name: str, pieces: Sequence[Piece], errors: list[HilsplatError]) -> list[Label]:
    """Join the pieces of a view into one label per object; append errors of invalid labels."""
    things: dict[Any, list[Piece]] = {}
    for row, piece in enumerate(pieces):
        key = row if piece.number is None else repr((piece.text, piece.number))
        things.setdefault(key, []).append(piece)
    ids = [same[0].number for same in things.values()]
    is_id = all(type(number) is int and number > 0 for number in ids) and len(set(ids)) == len(ids)
    labels = []
    for number, same in zip(ids if is_id else range(1, 1 + len(ids)), things.values(), strict=True):
        keys = same[0].keys
        try:
            label = Label.read(
                name,
                id=number,
                level=1 if keys.get("level") is None else keys["level"],
                parent=keys.get("parent") if is_id else None,
                text=same[0].text,
                polygons=[ring for piece in same for ring in piece.rings],
                origin=keys.get("origin") or "drawn",
            )
            labels.append(label)
        except SceneError as error:
            errors.append(error)
    return labels


Reader = Callable[[str, Any], Piece | str]
"""Converts an annotation, quoting its place in errors, or returns the reason why it is left out."""


def _isat_reader(name: str, content: Mapping[str, Any], cameras: Cameras, photos: Photos) -> Reader:
    drawn_hw = isat.stated_size(name, content.get("info"))
    view = _view(name, content["info"].get("name"), cameras, photos)
    camera = _drawn_camera(content["info"], cameras[view])
    things: list[isat.IsatObject] = []
    for entry in content["objects"]:
        with suppress(HilsplatError), foreign(name):  # `read` reports it
            things.append(isat.read_object(name, entry, drawn_hw, []))

    def read(where: str, entry: Any) -> Piece | str:
        thing = isat.cut_background(isat.read_object(where, entry, drawn_hw, []), things, drawn_hw)
        if thing.category == isat.BACKGROUND:
            return f"of the background ({isat.BACKGROUND}), cut out of the regions below them"
        # Without our keys, groups are ignored: in LERF-OVS's files, group numbers are not unique.
        number = entry.get("id", entry.get("group") if "level" in entry else None)
        rings = placed_rings(thing.polygons, drawn_hw, camera, where)
        return Piece(view, thing.category, number, rings, entry)

    return read


def _labelme_reader(name: str, content: Mapping[str, Any], cameras: Cameras, photos: Photos) -> Reader:
    view = _view(name, content.get("imagePath"), cameras, photos)
    camera = _drawn_camera(content, cameras[view])
    size: Mapping[str, Any] = {side: content.get(f"image{side.title()}") for side in ("height", "width")}
    if not any(size.values()) and content.get("imageData"):  # as in old versions
        with open_image(io.BytesIO(base64.b64decode(content["imageData"]))) as image:
            size = {"height": image.height, "width": image.width}
    elif not any(size.values()):
        size = _photo_size(photos, view)

    def read(where: str, entry: Any) -> Piece | str:
        drawn_hw = _drawn_hw(where, size, camera)
        kind, text = entry.get("shape_type") or "polygon", entry["label"]
        if kind in NO_AREA:
            return "without an area (points, lines)"
        points = _vertices(entry["points"], drawn_hw)
        if kind == "polygon" and "level" in entry:  # exported by us
            rings = placed_rings([points], drawn_hw, camera, where)
        else:
            mask = _labelme_mask(f"{where} ({text})", kind, points, entry.get("mask"), drawn_hw)
            rings = traced(placed(mask, camera, where))
        return Piece(view, text, entry.get("group_id"), rings, entry)

    return read


def _labelme_mask(
    where: str, kind: str, points: Float[np.ndarray, "P 2"], patch: Any, size_hw: tuple[int, int]
) -> Bool[np.ndarray, "H W"]:
    """Return the region of a shape as labelme draws it: with Pillow, or as a PNG in base64 at a box."""
    canvas = Image.new("1", size_hw[::-1])
    draw = ImageDraw.Draw(canvas)
    if kind == "mask" and len(points) == 2:
        with open_image(io.BytesIO(base64.b64decode(patch))) as image:
            pixels = Image.fromarray(np.asarray(image) != 0)
        corner, opposite = np.rint(points).astype(int)
        if (points == np.trunc(points)).all():  # labelme uses the box for whole numbers, else the PNG's size
            pixels = pixels.crop((0, 0, *(opposite - corner + 1).tolist()))
        canvas.paste(pixels, tuple(corner.tolist()))
    elif kind == "circle" and len(points) == 2:
        radius = math.dist(*points.tolist())
        draw.ellipse([*(points[0] - radius), *(points[0] + radius)], fill=1, outline=1)
    elif kind == "rectangle" and len(points) > 1:
        draw.rectangle([*points.min(axis=0), *points.max(axis=0)], fill=1, outline=1)
    elif kind in POLYGONS and len(points) > 2:
        draw.polygon(points.ravel().tolist(), fill=1, outline=1)
    else:
        expected = "circle or mask (2 points), rectangle (2 or more) or polygon (3 or more)"
        raise SceneError(f"{where} is a {kind} with {len(points)} points", expected=expected)
    return np.asarray(canvas)


def _coco_reader(name: str, content: Mapping[str, Any], cameras: Cameras, photos: Photos) -> Reader:
    images, categories = _by_id(content["images"]), _by_id(content["categories"])
    used = {_id(entry.get("image_id")) for entry in content["annotations"] if isinstance(entry, dict)}
    files = {str(image.get("file_name")) for number, image in images.items() if number in used}
    views = _matched(files, cameras, photos)
    num_files = Counter(views.values())
    foreign_names = ", ".join(sorted(file for file in files if views[file] is None)[:3])

    def read(where: str, entry: Any) -> Piece | str:
        image = images.get(_id(entry.get("image_id")), {})
        text = categories.get(_id(entry.get("category_id")), {}).get("name")
        view, region = views.get(str(image.get("file_name"))), entry.get("segmentation")
        if view is None:
            return f"of images that are not in the scene ({foreign_names or 'unknown ids'})"
        if num_files[view] > 1:  # such as copies that were cropped or mirrored for training
            return "of different images whose names fit the same photograph"
        if not isinstance(text, str | int):
            return "of unknown categories"
        if not region or entry.get("isbbox"):  # coco-annotator writes the corners of boxes as a region
            return "without a region (boxes, keypoints)"
        if image.get("height") is image.get("width") is None:
            image = _photo_size(photos, view)
        camera = _drawn_camera(image, cameras[view])
        mask = _coco_mask(where, region, image, camera)
        return Piece(view, str(text), entry.get("thing"), traced(placed(mask, camera, where)), entry)

    return read


def _by_id(rows: Sequence[Any]) -> dict[str, dict[str, Any]]:
    """Return rows by id; an id that different rows have is omitted."""
    rows = [row for row in rows if isinstance(row, dict)]
    by_id = {_id(row.get("id")): row for row in rows}
    twice = {number for row in rows if by_id[number := _id(row.get("id"))] != row}
    return {number: row for number, row in by_id.items() if number not in twice}


def _id(value: Any) -> str:
    """Return an id as text: spreadsheets and databases turn 7 into 7.0 or "7"."""
    return str(value).removesuffix(".0")


def _coco_mask(where: str, region: Any, image: Mapping[str, Any], camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Fill polygons (flat lists x1, y1, x2, ...) or run lengths, plain or compressed, as pycocotools does.

    The values are checked here, because pycocotools crashes or reads random memory if they are invalid.
    """
    if isinstance(region, list):
        size_hw = _drawn_hw(where, image, camera)
        nested = region if isinstance(region[0], list) and len(region[0]) > 2 else [region]
        polygons = [_vertices(flat, size_hw) for flat in nested]
        flat = [points.ravel().tolist() for points in polygons if len(points) > 2]  # 2 points would be a box
        if not flat:
            return np.zeros(size_hw, bool)
        return coco_masks.decode(coco_masks.merge(coco_masks.frPyObjects(flat, *size_hw))).astype(bool)
    height, width = _drawn_hw(where, dict(zip(("height", "width"), region["size"], strict=True)), camera)
    runs = {"size": [height, width], "counts": region["counts"]}
    if not isinstance(runs["counts"], str):
        if {*map(type, runs["counts"])} - {int}:
            raise ValueError("the run lengths are not whole numbers")
        runs = coco_masks.frPyObjects(runs, height, width)
    elif not re.fullmatch("([P-o]{0,6}[0-O])+", runs["counts"]):
        raise ValueError("the run lengths are damaged")
    try:
        coco_masks.decode({**runs, "size": [1, height * width - 1]})
    except ValueError:  # as it must be: the run lengths don't fit into an image that lacks one pixel
        return coco_masks.decode(runs).astype(bool)
    raise ValueError("the run lengths do not cover the image")


def _vertices(value: Any, size_hw: tuple[int, int]) -> Float[np.ndarray, "P 2"]:
    """Return vertices, given as pairs or as a flat list; raise ValueError if one is far outside the image."""
    points = np.array(value, np.float64).reshape(-1, 2)
    share = points / size_hw[::-1]
    if not ((share >= -SLACK) & (share <= 1 + SLACK)).all():  # also if it isn't a number
        raise ValueError(f"a vertex is far outside the image of {size_hw[1]} x {size_hw[0]} px")
    return points


def _photo_size(photos: Photos, view: str) -> dict[str, int]:
    """Return the size of a view's photograph, for a file that states none; empty if it is unknown."""
    return dict(zip(("height", "width"), photos.get(view, {}).get("photo_hw_px", ()), strict=False))


def _drawn_camera(content: Mapping[str, Any], camera: Camera) -> Camera:
    return of_view(camera) if is_on_view(content) else camera


def _drawn_hw(where: str, image: Mapping[str, Any], camera: Camera) -> tuple[int, int]:
    """Return the stated size of the image that was drawn on, which may be larger than the view."""
    size_hw = isat.stated_size(where, image)
    placement(camera, size_hw, where)  # raises an error if the shape does not fit
    return size_hw


def _matched(files: Iterable[str], cameras: Cameras, photos: Photos) -> dict[str, str | None]:
    """Return the view of each photograph, or None; the folders that its pose file states must be the same."""
    views = match_names(files, cameras.names)
    for file, view in views.items():
        photo = str(photos.get(view or "", {}).get("file", view))
        if view and Path(photo).stem == Path(view).stem and match_names([file], [photo])[file] is None:
            views[file] = None
    return views


def _view(name: str, image: Any, cameras: Cameras, photos: Photos) -> str:
    """Return the view of a photograph, or else of the file; raise SceneError if there is none."""
    view = _matched([image := str(image or name)], cameras, photos)[image]
    if view is None:
        expected = f"a name such as {cameras.names[0]}"
        raise SceneError(f"{name} does not match a photograph in this scene", expected=expected, found=image)
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
    for file in files:
        for view, labels in file.items():
            here = views.setdefault(view, [])
            number_of: dict[tuple[int, int], int] = {}  # of an id in the file and its level
            for label in sorted(labels, key=lambda label: label.level):
                parent = number_of.get((label.parent or 0, label.level - 1))
                mask = label.mask(sizes_hw[view])
                row = _row_of(label, mask, here, sizes_hw[view])
                number = here[row].id if row is not None else _number(label, here, things)
                number_of[label.id, label.level], things[number] = number, _kind(label)
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
