"""Labels at three levels: Hi-LERF and Hi-3DOVS (on images of LERF-OVS and 3D-OVS), and your annotations.

The paper publishes the frames and levels, but not the labels or their format. We use LERF-OVS's format with
three more keys per object: `id`, unique in the file; `level`, 1 whole, 2 part, 3 subpart; `parent`, the
id of an object one level up, or null. `segmentation` may be a list of polygons. `hilsplat annotate` writes
this format for your own scenes (data set `annotated`) and adds `origin`: drawn, edited, accepted or proposed.

Missing files, invalid ids and levels, and unusable label files raise SceneError.
"""

from collections.abc import Hashable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from hilsplat.base.errors import SceneError
from hilsplat.base.levels import Level, plain_text
from hilsplat.datasets.dataset import Dataset
from hilsplat.datasets.images.isat import IsatFile, IsatObject, fill_polygons, read_isat
from hilsplat.datasets.images.lerf_ovs import label_files, merged_regions
from hilsplat.datasets.labelled import LabelledRegion, LabelledScene, images_by_view
from hilsplat.datasets.published import FRAMES, differences

IMAGES_OF = {"hi_lerf": "lerf_ovs", "hi_3dovs": "3d_ovs"}
"""Data set -> folder with its images, next to the data set's own folder."""

PROPOSED = "proposed"
"""Value of `origin` for objects proposed by a program, which are ignored until the user accepts them."""

MIN_POSED = 0.5
"""Minimum share of annotated photographs with a pose; below it, they probably show another scene."""

MAX_OUTSIDE = 0.01  # share of a child's area that may be outside its parent, to allow for rasterised borders


def open_hi(dataset: str, root: Path, scene: str) -> LabelledScene:
    """Read the labels of a scene in `dataset`: one region per object; objects may share a text."""
    HI_DATASETS[dataset].require(root, scene)
    source = root.parent / IMAGES_OF[dataset] / scene
    images = images_by_view(source / "images")
    warnings: list[str] = []
    views: dict[str, tuple[LabelledRegion, ...]] = {}
    files = label_files(root / "label" / scene)
    for view, path in files.items():
        if view not in images:
            warnings.append(f"label file {path} has no image in {source / 'images'}: skipped")
            continue
        labels = read_isat(path, images[view])
        warnings += labels.warnings
        views[view] = regions_of(labels, warnings)
    warnings += differences(dataset, scene, {"image": images, "label": files})
    return LabelledScene(dataset, scene, images, source, views, tuple(warnings))


def open_annotated(root: Path, scene: str) -> LabelledScene:
    """Read your annotations of a scene, such as "photos/desk": one region per drawn or accepted object.

    Files whose objects have no level are read like those of LERF-OVS: one region per text. The images are
    the scene's own photographs, distorted or not; evaluation compares the labels' size with the cameras.
    """
    ANNOTATED.require(root, scene)
    warnings: list[str] = []
    files = label_files(root / scene)
    views = {view: annotated_regions(path, warnings) for view, path in files.items()}
    return LabelledScene("annotated", scene, {}, None, views, tuple(warnings), MIN_POSED)


def annotated_regions(path: Path, warnings: list[str]) -> tuple[LabelledRegion, ...]:
    """Read the regions of one file as `open_annotated` does; append to `warnings`."""
    labels = read_isat(path)
    warnings += labels.warnings
    has_levels = any("level" in thing.keys for thing in labels.objects)
    regions = regions_of(labels, warnings) if has_levels else merged_regions(labels)
    return tuple(replace(region, on_view=labels.on_view) for region in regions)


def regions_of(labels: IsatFile, warnings: list[str]) -> tuple[LabelledRegion, ...]:
    """Return one region per object in a file, skipping proposals and repetitions; append to `warnings`."""
    waiting = [thing for thing in labels.objects if thing.keys.get("origin") == PROPOSED]
    if waiting:
        warnings.append(f"{labels.path.name}: ignored {len(waiting)} unaccepted proposal(s)")
        accepted = tuple(thing for thing in labels.objects if thing not in waiting)
        labels = replace(labels, objects=accepted)
    objects = by_id(labels)
    parents = parents_of(labels, objects, warnings)
    warnings += _nesting_violations(labels, objects, parents)
    regions = []
    first: dict[Hashable, int] = {}
    for number, thing in objects.items():
        rings = tuple(polygon.tobytes() for polygon in thing.polygons)
        twin = first.setdefault((plain_text(thing.category), thing.keys["level"], rings), number)
        if twin != number:
            warnings.append(f"{labels.path.name}: id {number} ({thing.category}) repeats id {twin}; ignored")
            continue
        path = [thing.category]
        ancestor = parents[number]
        while ancestor is not None:
            path.insert(0, objects[ancestor].category)
            ancestor = parents[ancestor]
        pixels = partial(fill_polygons, thing.polygons, labels.size_hw)
        level = Level(thing.keys["level"])
        box = thing.box_xyxy[None]
        regions.append(LabelledRegion(thing.category, labels.size_hw, pixels, box, level, tuple(path)))
    return tuple(regions)


def by_id(labels: IsatFile) -> dict[int, IsatObject]:
    """Return the objects of a file by `id`; if they have none, each ISAT group forms one object."""
    objects: dict[int, IsatObject] = {}
    for row, thing in enumerate(labels.objects):
        where = f"{labels.path}, object {row} ({thing.category})"
        level = thing.keys.get("level")
        number = thing.keys.get("id", thing.keys.get("group"))
        same = objects.get(number) if isinstance(number, int) else None
        is_piece = same is not None and "id" not in thing.keys and same.category == thing.category
        if type(number) is not int or (same is not None and not is_piece):
            raise SceneError(
                f"{where}: invalid id",
                expected="an integer, unique in the file",
                found=repr(number),
                fix="give each object in the file a unique id",
            )
        if type(level) is not int or level not in list(Level):
            raise SceneError(
                f"{where}: invalid level",
                expected="1 (whole), 2 (part) or 3 (subpart)",
                found=repr(level),
                fix="correct the level; labels without levels (LERF-OVS) belong in lerf_ovs/label",
            )
        if same is not None:
            low = np.minimum(same.box_xyxy[:2], thing.box_xyxy[:2])
            high = np.maximum(same.box_xyxy[2:], thing.box_xyxy[2:])
            polygons = (*same.polygons, *thing.polygons)
            thing = replace(same, polygons=polygons, box_xyxy=np.concatenate([low, high]))
        objects[number] = thing
    return objects


def parents_of(
    labels: IsatFile, objects: Mapping[int, IsatObject], warnings: list[str]
) -> dict[int, int | None]:
    """Return the parent id of every object; None for objects without a valid parent."""
    parents: dict[int, int | None] = {}
    for number, thing in objects.items():
        parent, level = thing.keys.get("parent"), thing.keys["level"]
        parents[number] = None
        if parent is None:
            continue
        where = f"{labels.path.name}, id {number} ({thing.category})"
        if not isinstance(parent, int) or parent not in objects:
            warnings.append(f"{where}: parent {parent!r} does not exist")
        elif objects[parent].keys["level"] != level - 1:
            level_of_parent = objects[parent].keys["level"]
            warnings.append(f"{where}, level {level}: parent {parent} has level {level_of_parent}")
        else:
            parents[number] = parent
    return parents


def _nesting_violations(
    labels: IsatFile, objects: Mapping[int, IsatObject], parents: Mapping[int, int | None]
) -> list[str]:
    """Return a sentence for every child with more than `MAX_OUTSIDE` of its area outside its parent."""
    masks = {number: fill_polygons(thing.polygons, labels.size_hw) for number, thing in objects.items()}
    sentences = []
    for number, parent in parents.items():
        if parent is None:
            continue
        area_px = np.count_nonzero(masks[number])
        outside = np.count_nonzero(masks[number] & ~masks[parent])
        if outside > MAX_OUTSIDE * area_px:
            sentences.append(
                f"{labels.path.name}, id {number} ({objects[number].category}): {outside / area_px:.1%} of "
                f"its area is outside its parent {parent} ({objects[parent].category})"
            )
    return sentences


def _dataset(name: str, title: str, frame: str) -> Dataset:
    """Return the description of Hi-LERF or Hi-3DOVS, which share a layout."""
    images = IMAGES_OF[name]
    return Dataset(
        name=name,
        title=title,
        labels="images",
        scenes=tuple(FRAMES[name]),
        licence="labels unpublished; images under their data set's licence",
        terms="Write your own labels in our format; the terms of the images apply.",
        citation="Hi-LSplat (frames and levels)",
        layout=f"""{name}/
  label/<scene>/{frame}.json ...      our format (docs/datasets.md)
{images}/
  <scene>/images, sparse              as in that data set""",
        required=lambda scene: (f"label/{scene}", f"../{images}/{scene}/images"),
        open=partial(open_hi, name),
        label_places=lambda scene: (f"label/{scene}/*.json",),
        images_of=images,
    )


HI_LERF = _dataset("hi_lerf", "Hi-LERF", "frame_00041")
HI_3DOVS = _dataset("hi_3dovs", "Hi-3DOVS", "01")
HI_DATASETS: dict[str, Dataset] = {dataset.name: dataset for dataset in (HI_LERF, HI_3DOVS)}


class Annotated(Dataset):
    """A data set without published scenes: its scenes are those that have been annotated."""

    def root(self, data_root: Path | str) -> Path:
        """Return the folder in `data_root`, or that in the working folder if `data_root` has none."""
        inside, here = super().root(data_root), Path(self.name)
        return inside if inside.is_dir() or not here.is_dir() else here

    def locate(self, data_root: Path) -> Path:
        root = self.root(data_root)  # not searched elsewhere: any results look like annotations
        if not self.found(root):
            raise SceneError(f"there are no annotations in {root}", fix="draw them: hilsplat annotate SCENE")
        return root

    def found(self, root: Path) -> tuple[str, ...]:
        files = root.glob("*/*/*.json")
        return tuple(sorted({f"{path.parent.parent.name}/{path.parent.name}" for path in files}))


ANNOTATED = Annotated(
    name="annotated",
    title="your annotations",
    labels="images",
    scenes=(),
    licence="your choice; the photographs keep their licence",
    terms="Draw annotations with: hilsplat annotate SCENE",
    citation="none",
    layout="""annotated/
  <dataset>/<scene>/DSC_0001.json ...   our format (docs/datasets.md), one file per photograph""",
    required=lambda scene: (scene,),
    open=open_annotated,
    label_places=lambda scene: (f"{scene}/*.json",),
    images_of="photos",
)
