"""The supported data sets, by name.

A reader's module describes its data set in a constant (see `dataset.Dataset`); one line here adds it.
"""

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from hilsplat.base.errors import SceneError
from hilsplat.base.plugins import Plugins
from hilsplat.datasets.dataset import Dataset

if TYPE_CHECKING:  # imports OpenCV and SciPy, which the start of the workflow and the tables don't need
    from hilsplat.datasets.labelled import LabelledScene
    from hilsplat.datasets.points.labelled_points import PointScene

DATASETS: Plugins[Dataset] = Plugins(
    {
        "lerf_ovs": "hilsplat.datasets.images.lerf_ovs:DATASET",
        "lerf_mask": "hilsplat.datasets.images.lerf_mask:DATASET",
        "3d_ovs": "hilsplat.datasets.images.ovs3d:DATASET",
        "hi_lerf": "hilsplat.datasets.images.hi:HI_LERF",
        "hi_3dovs": "hilsplat.datasets.images.hi:HI_3DOVS",
        "annotated": "hilsplat.datasets.images.annotated:DATASET",
        "scannet": "hilsplat.datasets.points.scannet:DATASET",
        "scannet200": "hilsplat.datasets.points.scannet:SCANNET200_DATASET",
        "replica": "hilsplat.datasets.points.replica:DATASET",
        "waymo": "hilsplat.datasets.waymo.reader:DATASET",
    }
)
"""Supported data sets in the order of the paper's tables."""


def readers_of(labels: Collection[str]) -> tuple[str, ...]:
    """Return the places of the readers for labels such as "lerf_ovs/figurines" (see `base.plugins`)."""
    names = {name.partition("/")[0] for name in labels}
    return tuple(DATASETS.places[name] for name in sorted(names) if name in DATASETS)


def open_labelled(name: str, data_root: Path) -> "LabelledScene":
    """Open a scene with labels on images, by a name such as "lerf_ovs/figurines".

    Raises:
        SceneError: there is no such data set, its labels are on points, or the scene cannot be read.
    """
    dataset_name, _, scene = name.partition("/")
    dataset = dataset_of(dataset_name)
    if dataset.labels != "images" or not scene:
        raise SceneError(
            f"{name!r} names no scene with labels on images",
            expected="<data set>/<scene>, such as lerf_ovs/figurines",
            found=f"a data set with labels on {dataset.labels}" if scene else "no scene",
            fix="list them with: hilsplat datasets list",
        )
    return dataset.open(dataset.locate(data_root), scene)


def open_labels(name: str, data_root: Path) -> "LabelledScene | PointScene":
    """Open a scene with labels on images or points, by a name such as "scannet/scene0000_00".

    Raises:
        SceneError: there is no such data set, no scene is named, or the scene cannot be read.
    """
    dataset_name, _, scene = name.partition("/")
    dataset = dataset_of(dataset_name)
    if not scene:
        raise SceneError(
            f"{name!r} names no scene",
            expected="<data set>/<scene>, such as scannet/scene0000_00",
            fix="list them with: hilsplat datasets list",
        )
    return dataset.open(dataset.locate(data_root), scene)


def dataset_of(name: str) -> Dataset:
    """Look up a data set.

    Raises:
        SceneError: there is no data set with this name.
    """
    try:
        return DATASETS[name]
    except KeyError as error:
        raise SceneError(
            f"data set {name!r} is unknown",
            expected=f"one of {', '.join(DATASETS)}",
            fix="list them with: hilsplat datasets list",
        ) from error
