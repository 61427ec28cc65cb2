"""The data sets that can be read, by name.

A reader's module describes its data set in a constant (see `dataset.Dataset`); one line here adds it.
"""

from pathlib import Path

from hilsplat.base.errors import SceneError
from hilsplat.datasets.dataset import Dataset
from hilsplat.datasets.images.hi import HI_3DOVS, HI_LERF
from hilsplat.datasets.images.lerf_mask import DATASET as LERF_MASK
from hilsplat.datasets.images.lerf_ovs import DATASET as LERF_OVS
from hilsplat.datasets.images.ovs3d import DATASET as OVS_3D
from hilsplat.datasets.labelled import LabelledScene
from hilsplat.datasets.points.labelled_points import PointScene
from hilsplat.datasets.points.replica import DATASET as REPLICA
from hilsplat.datasets.points.scannet import DATASET as SCANNET
from hilsplat.datasets.points.scannet import SCANNET200_DATASET as SCANNET200
from hilsplat.datasets.waymo.reader import DATASET as WAYMO

DATASETS: dict[str, Dataset] = {
    dataset.name: dataset
    for dataset in (
        LERF_OVS,
        LERF_MASK,
        OVS_3D,
        HI_LERF,
        HI_3DOVS,
        SCANNET,
        SCANNET200,
        REPLICA,
        WAYMO,
    )
}
"""By name, in the order of the paper's tables."""


def open_labelled(name: str, data_root: Path) -> LabelledScene:
    """Open a scene with labels on images, named as in "lerf_ovs/figurines".

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


def open_labels(name: str, data_root: Path) -> LabelledScene | PointScene:
    """Open a scene with labels on images or points, named as in "scannet/scene0000_00".

    Raises:
        SceneError: there is no such data set, no scene is named, or it cannot be read.
    """
    dataset_name, _, scene = name.partition("/")
    dataset = dataset_of(dataset_name)
    if dataset.labels == "images":
        return open_labelled(name, data_root)
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
        SceneError: there is none of this name.
    """
    try:
        return DATASETS[name]
    except KeyError as error:
        raise SceneError(
            f"data set {name!r} is unknown",
            expected=f"one of {', '.join(DATASETS)}",
            fix="list them with: hilsplat datasets list",
        ) from error
