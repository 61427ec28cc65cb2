"""The supported data sets by name, and the output of `hilsplat datasets`.

A reader's module describes its data set in a constant (see `dataset.Dataset`); one line here registers it.
Packages of others register theirs as entry points of the group `hilsplat.datasets` (docs/extending.md).
"""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from hilsplat.base.errors import HilsplatError, SceneError
from hilsplat.base.plugins import Plugins, entry_points
from hilsplat.datasets.dataset import Dataset

if TYPE_CHECKING:  # imports OpenCV and SciPy, which workflow start-up and tables don't need
    from hilsplat.datasets.labelled import LabelledScene
    from hilsplat.datasets.points.labelled_points import PointScene

_OURS = {
    "lerf_ovs": "hilsplat.datasets.images.lerf_ovs:DATASET",
    "lerf_mask": "hilsplat.datasets.images.lerf_mask:DATASET",
    "3d_ovs": "hilsplat.datasets.images.ovs3d:DATASET",
    "hi_lerf": "hilsplat.datasets.images.hi:HI_LERF",
    "hi_3dovs": "hilsplat.datasets.images.hi:HI_3DOVS",
    "annotated": "hilsplat.datasets.images.hi:ANNOTATED",
    "scannet": "hilsplat.datasets.points.scannet:DATASET",
    "scannet200": "hilsplat.datasets.points.scannet:SCANNET200_DATASET",
    "replica": "hilsplat.datasets.points.replica:DATASET",
    "waymo": "hilsplat.datasets.waymo.reader:DATASET",
}
_GROUP, _TAKEN = "hilsplat.datasets", (*_OURS, *entry_points("hilsplat.generators"))
DATASETS: Plugins[Dataset] = Plugins(
    _GROUP, {**_OURS, **entry_points(_GROUP, Dataset, _TAKEN).places}, Dataset
)
"""Supported data sets in the order of the paper's tables."""


ANNOTATED = "annotated"
"""Data set of your own annotations, whose scenes are named `data set/scene`."""


def readers_of(labels: Collection[str]) -> tuple[str, ...]:
    """Return the import paths of what reads labels, such as "lerf_ovs/figurines" or "world:room:1"."""
    places = {**entry_points("hilsplat.generators").places, **DATASETS.places}
    names = {name.partition("/")[0].partition(":")[0] for name in labels}
    return tuple(places[name] for name in sorted(names) if name in places)


LISTED = "to list all data sets and scenes, run: hilsplat datasets list"


def open_labelled(name: str, data_root: Path) -> "LabelledScene":
    """Open a scene with labels on images, such as "lerf_ovs/figurines"; raise SceneError if there is none."""
    dataset = dataset_of(name.partition("/")[0])
    if dataset.labels != "images":
        raise SceneError(
            f"{name!r} is not a scene with labelled images",
            expected="<data set>/<scene>, such as lerf_ovs/figurines",
            found=f"a data set with labels on {dataset.labels}",
            fix=LISTED,
        )
    return cast("LabelledScene", open_labels(name, data_root))


def open_labels(name: str, data_root: Path) -> "LabelledScene | PointScene":
    """Open a scene with any kind of labels, such as "scannet/scene0000_00"; raise SceneError on failure."""
    dataset, scene = scene_of(name)
    return dataset.open(dataset.locate(data_root), scene)


def scene_of(name: str) -> tuple[Dataset, str]:
    """Return the data set and scene in a name such as "scannet/scene0000_00"; raise SceneError if unknown."""
    dataset_name, _, scene = name.partition("/")
    dataset = dataset_of(dataset_name)
    if not scene:
        expected = "<data set>/<scene>, such as scannet/scene0000_00"
        raise SceneError(f"{name!r} does not contain a scene name", expected=expected, fix=LISTED)
    return dataset, scene


def dataset_of(name: str) -> Dataset:
    """Return a data set by name; raise a SceneError that lists the known names if it is unknown."""
    if name not in DATASETS:
        raise SceneError(
            f"data set {name!r} is unknown", expected=f"one of {', '.join(DATASETS)}", fix=LISTED
        )
    return DATASETS[name]


def overview(data_root: Path | None) -> str:
    """Describe all data sets and, if a folder is given, list the scenes found in it."""
    paragraphs = []
    for dataset in DATASETS.values():
        lines = [
            f"{dataset.name}: {dataset.title}, labels on {dataset.labels}",
            *([f"  get it    {dataset.origin}"] if dataset.origin else []),
            f"  citation  {dataset.citation}",
            f"  licence   {dataset.licence}",
            f"  terms     {dataset.terms}",
            f"  scenes    {', '.join(dataset.scenes) or 'all that are present'}",
        ]
        if data_root is not None:
            lines.extend(f"  {line}" for line in _presence(dataset, data_root))
        lines.append("  layout")
        lines.extend(f"    {line}" for line in dataset.layout.rstrip().splitlines())
        paragraphs.append("\n".join(lines))
    return "\n\n".join(paragraphs)


def _presence(dataset: Dataset, data_root: Path) -> list[str]:
    """Return lines that list a data set's complete scenes, and the paths missing from its other scenes."""
    try:
        root = dataset.locate(data_root)
    except SceneError as error:
        return ["found     no scene", *(f"          {line}" for line in str(error).splitlines())]
    lines = [f"found     {', '.join(dataset.found(root)) or 'no complete scene'} (in {root})"]
    for scene in dataset.scenes:
        missing = dataset.missing(root, scene)
        if missing:
            lines.append(f"missing   {scene}: {', '.join(missing)}")
    return lines


def check(dataset: Dataset, data_root: Path, scenes: Sequence[str] = ()) -> tuple[str, int]:
    """Read whole scenes of a data set (default: every scene that is at least partly present).

    Return a report of what was found, and the number of scenes that cannot be read. Raise SceneError if the
    data set's folder is missing.
    """
    root = dataset.locate(data_root)
    absent = [scene for scene in dataset.scenes if not (scenes or dataset.has_part(root, scene))]
    known = dataset.scenes or dataset.found(root)
    lines, num_failed = [], 0
    for scene in scenes or [scene for scene in known if scene not in absent]:
        try:
            report = dataset.check(root, scene)
        except HilsplatError as error:
            num_failed += 1
            lines.append(f"{dataset.name}/{scene}: cannot be read")
            lines.extend(f"  {line}" for line in str(error).splitlines())
            continue
        facts = ", ".join(f"{what}: {value}" for what, value in report.facts.items())
        lines.append(f"{dataset.name}/{scene}: {facts}")
        lines.extend(f"  warning   {sentence}" for sentence in report.warnings)
    if absent:
        lines.append(f"{dataset.name}: missing: {', '.join(absent)}")
    return "\n".join(lines), num_failed
