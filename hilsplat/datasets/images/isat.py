"""Reader of label files from the ISAT annotation tool, as in LERF-OVS; rasterising and tracing of polygons.

`objects` is a list. In each object, `category` is the text, `segmentation` is one polygon as a list of [x, y]
(a list of polygons is also accepted), and `bbox` is [x1, y1, x2, y2]. `group` does not identify an object,
because its numbers restart and repeat. Regions of the category `BACKGROUND` are cut out of objects with a
lower `layer`. Unknown keys are ignored.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Int64

from hilsplat.base.errors import SceneError
from hilsplat.base.images import image_size_hw
from hilsplat.base.levels import composed
from hilsplat.datasets.labelled import check_label_size
from hilsplat.scene.layouts import read_json_object
from hilsplat.scene.placement import is_on_view

Polygon = Float[np.ndarray, "_ 2"] | Int[np.ndarray, "_ 2"] | Sequence[tuple[int, int]]

BACKGROUND = "__background__"  # ISAT's category of regions that belong to no object, such as holes

MAX_SIDE_PX = 20_000
"""Limit on the image size stated in a label file; drawing regions at a wrong size could exhaust memory."""

SLACK_PX = 1.0
"""Distance by which vertices may be outside the image, and boxes may differ from their polygons, without a
warning."""


def fill_polygons(polygons: Sequence[Polygon], size_hw: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Return the union of polygons (vertices x, y, truncated to integers): even-odd fill, borders included.

    This is OpenCV's `fillPoly` on int32 vertices, as in LangSplat's evaluation. Vertex (x, y) is the
    pixel (x, y), so the triangle (0, 0), (2, 0), (0, 2) has 6 pixels. The result is clipped to the image.
    """
    canvas = np.zeros(size_hw, dtype=np.uint8)
    for polygon in polygons:  # a single call would omit pixels that two polygons share
        cv2.fillPoly(canvas, [np.asarray(polygon).astype(np.int32)], 1)
    return canvas.astype(bool)


def trace_polygons(mask: Bool[np.ndarray, "H W"]) -> list[Int[np.ndarray, "_ 2"]]:
    """Return disjoint polygons whose union, filled by `fill_polygons`, equals the mask exactly.

    A polygon cannot have a hole, so the mask is cut vertically through the middle of each hole.
    """
    mode, every = cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE
    contours, ranks = cv2.findContours(mask.astype(np.uint8), mode, every)
    if not contours:
        return []
    holes = [contour for contour, rank in zip(contours, ranks[0], strict=True) if rank[3] >= 0]
    middles = {int(contour[..., 0].min() + contour[..., 0].max() + 1) // 2 for contour in holes}
    edges = [0, *sorted(middles), mask.shape[1]]
    polygons: list[np.ndarray] = []
    for left, right in pairwise(edges):
        strip = np.ascontiguousarray(mask[:, left:right], np.uint8)
        for contour in cv2.findContours(strip, mode, every)[0]:
            points = contour.reshape(-1, 2).astype(np.int64) + np.array([left, 0])
            polygons.append(np.concatenate([points, points[-1:].repeat(max(0, 3 - len(points)), axis=0)]))
    return polygons


@dataclass(frozen=True, eq=False)
class IsatObject:
    category: str  # the text, in composed Unicode
    polygons: tuple[Float[np.ndarray, "_ 2"], ...]  # vertices, px; the region is their filled union
    box_xyxy: Int64[np.ndarray, " 4"]  # whole pixels inside the annotated box, borders included
    keys: Mapping[str, Any]  # all keys of the object in the file

    @property
    def layer(self) -> float:
        layer = self.keys.get("layer")
        return layer if isinstance(layer, int | float) else 0


@dataclass(frozen=True, eq=False)
class IsatFile:
    """The objects of one image, in the order of the file, and a warning for each irregularity.

    `on_view` means that the file states that they were drawn on the view, not on its photograph.
    """

    path: Path
    size_hw: tuple[int, int]
    objects: tuple[IsatObject, ...]
    warnings: tuple[str, ...] = ()
    on_view: bool = False


def read_isat(path: Path, image: Path | None = None) -> IsatFile:
    """Read and check one label file; if its image is given, also compare their sizes.

    Raises:
        SceneError: the file is not JSON, a key is missing or has the wrong type, a polygon is entirely
            outside the image, a box is [x, y, width, height], or the aspect ratios differ.
    """
    content = read_json_object(path, "unpack or export the labels again")
    if not isinstance(content.get("objects"), list):
        raise SceneError(
            f"label file {path} has no `objects` list",
            expected="an ISAT file with the keys info and objects",
            found=f"keys {', '.join(content)}",
            fix="import the labels of other tools (labelme, COCO) with hilsplat annotate",
        )
    size_hw = stated_size(f"label file {path}", content.get("info"))
    warnings: list[str] = []
    name = content["info"].get("name")
    if isinstance(name, str) and name and Path(name).stem != path.stem:
        warnings.append(f"{path.name} names {name} as its image, but is used for {path.stem}")
    things = [
        read_object(f"{path}, object {number}", entry, size_hw, warnings)
        for number, entry in enumerate(content["objects"])
    ]
    objects = tuple(cut_background(item, things, size_hw) for item in things if item.category != BACKGROUND)
    if image is not None:
        warnings += check_label_size(f"label file {path}", size_hw, image_size_hw(image))
    return IsatFile(path, size_hw, objects, tuple(warnings), is_on_view(content["info"]))


def stated_size(where: str, content: Any) -> tuple[int, int]:
    """Return the size under the keys `height` and `width`; raise SceneError if it is missing or invalid."""
    sides: list[Any] = [
        content.get(key) if isinstance(content, dict) else None for key in ("height", "width")
    ]
    if not all(type(side) in (int, float) and 0 < side <= MAX_SIDE_PX and side % 1 == 0 for side in sides):
        raise SceneError(
            f"{where} does not state a valid image size",
            expected=f"height and width in pixels, at most {MAX_SIDE_PX}",
            found=f"height {sides[0]!r}, width {sides[1]!r}",
            fix="export the labels again, with the size of the image, or as COCO",
        )
    return int(sides[0]), int(sides[1])


def read_object(where: str, entry: Any, size_hw: tuple[int, int], warnings: list[str]) -> IsatObject:
    """Convert and check one object; append irregularities to `warnings`. For errors, see `read_isat`."""
    if not isinstance(entry, dict):
        raise SceneError(
            f"{where} is not a JSON object", found=repr(entry)[:80], fix="export the labels again"
        )
    category = entry.get("category")
    if not isinstance(category, str) or not category.strip():
        raise SceneError(f"{where} has no category", found=repr(category), fix="enter the query text")
    category = composed(category)
    where = f"{where} ({category})"
    polygons = _polygons(where, entry.get("segmentation"))
    height, width = size_hw
    for polygon in polygons:
        low, high = polygon.min(axis=0), polygon.max(axis=0)
        if high[0] < 0 or high[1] < 0 or low[0] >= width or low[1] >= height:
            raise SceneError(
                f"{where}: a polygon is entirely outside the image",
                expected=f"x below {width}, y below {height}",
                found=f"x {low[0]:g} to {high[0]:g}, y {low[1]:g} to {high[1]:g}",
                fix="use labels and images of the same size and release",
            )
        if len(polygon) < 3:
            warnings.append(f"{where}: a polygon has {len(polygon)} vertices; treated as a line")
    points = np.concatenate(polygons)
    reach = float(max((-points).max(), (points - [width, height]).max()))
    if reach > SLACK_PX:
        warnings.append(f"{where}: a polygon extends {reach:g} px beyond the image; clipped")
    return IsatObject(category, polygons, _box(where, entry.get("bbox"), points, warnings), entry)


def cut_background(thing: IsatObject, things: Sequence[IsatObject], size_hw: tuple[int, int]) -> IsatObject:
    """Return an object without the `BACKGROUND` regions of a file that are in higher layers."""
    holes = [
        polygon
        for other in things
        if other.category == BACKGROUND and other.layer > thing.layer
        for polygon in other.polygons
    ]
    if not holes:
        return thing
    mask = fill_polygons(thing.polygons, size_hw) & ~fill_polygons(holes, size_hw)
    return replace(thing, polygons=tuple(trace_polygons(mask)))


def _polygons(where: str, value: Any) -> tuple[Float[np.ndarray, "_ 2"], ...]:
    """Return the polygons, given one polygon or a list of polygons, each a list of [x, y] pairs."""
    try:
        nested = isinstance(value[0][0], list)
        polygons = tuple(np.array(points, dtype=np.float64) for points in (value if nested else [value]))
        usable = all(ring.shape == (len(ring), 2) and (abs(ring) < 2**31).all() for ring in polygons)
    except (ArithmeticError, LookupError, TypeError, ValueError):
        usable = False
    if not usable:
        raise SceneError(
            f"{where}: segmentation is not a polygon",
            expected="a list of [x, y] pairs, or a list of such lists",
            found=repr(value)[:80],
            fix="export the labels again; flat COCO lists (x1, y1, x2, ...) are not supported",
        )
    return polygons


def _box(
    where: str, value: Any, points: Float[np.ndarray, "P 2"], warnings: list[str]
) -> Int64[np.ndarray, " 4"]:
    """Return the whole pixels inside the box [x1, y1, x2, y2] or, if there is none, the polygon's extent."""
    extent = np.concatenate([points.min(axis=0), points.max(axis=0)])
    try:
        box = extent if value is None else np.array(value, dtype=np.float64)
        usable = box.shape == (4,) and bool(np.isfinite(box).all())
    except (ArithmeticError, TypeError, ValueError):
        usable = False
    if not usable:
        raise SceneError(
            f"{where}: invalid bbox", expected="[x1, y1, x2, y2]", found=repr(value), fix="edit or remove it"
        )
    if np.abs(box - extent).max() > SLACK_PX:
        as_sizes = np.concatenate([box[:2], box[:2] + box[2:]])
        if np.abs(as_sizes - extent).max() <= SLACK_PX or (box[2:] < box[:2]).any():
            raise SceneError(
                f"{where}: bbox is not [x1, y1, x2, y2]",
                expected=f"{extent.tolist()}, the polygon's extent",
                found=f"{box.tolist()}, probably [x, y, width, height]",
                fix="convert the boxes, or remove bbox to use the polygon's extent",
            )
        warnings.append(f"{where}: bbox {box.tolist()} differs from the polygon's extent {extent.tolist()}")
    # Evaluation tests x1 <= x <= x2 for whole numbers x, so rounding inwards changes no result.
    return np.concatenate([np.ceil(box[:2]), np.floor(box[2:])]).astype(np.int64)
