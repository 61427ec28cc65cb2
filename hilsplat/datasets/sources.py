"""Sources named in the scene sheet: which published scenes are present, and the files that each scene uses.

The workflow uses this module at start-up, so it reads no data and imports no heavy library at module level.
"""

import logging
from collections.abc import Collection
from pathlib import Path

from hilsplat.base.errors import SceneError, SettingsError, in_one_line
from hilsplat.base.lineage import files_of
from hilsplat.datasets.registry import ANNOTATED, DATASETS, dataset_of, open_labels, scene_of
from hilsplat.scene.sheet import DATA_PREFIX

logger = logging.getLogger(__name__)

LEVELLED = ("hi_lerf", "hi_3dovs")  # data sets whose labels have levels


def published(source: str) -> tuple[str, str] | None:
    """Return the data set and scene of a source such as `data:lerf_ovs/figurines`; None for anything else."""
    name, _, scene = source.removeprefix(DATA_PREFIX).partition("/")
    return (name, scene) if source.startswith(DATA_PREFIX) and scene and name in DATASETS else None


def absence(source: str, data_root: str) -> str | None:
    """Return the reason why a `data:` source cannot be used, or None; `data_root` is empty if not set."""
    if not source.startswith(DATA_PREFIX):
        return None
    if not data_root:
        return "data_root is not set"
    root = Path(data_root).expanduser()
    if not root.is_dir():
        return f"data_root {data_root} is not a folder"
    names = published(source)
    if names is None:
        folder = root / source.removeprefix(DATA_PREFIX)
        return None if folder.is_dir() else f"{folder} is missing"
    dataset = dataset_of(names[0])
    try:
        dataset.require(dataset.locate(root), names[1])
    except SceneError as error:
        return in_one_line(error)
    return None


def is_open_ended(name: str) -> bool:
    """Return whether a data set has images but no scene list (Waymo); its group has the same name."""
    return name in DATASETS and not DATASETS[name].scenes and not DATASETS[name].images_of


def unlisted(sources: Collection[str], groups: Collection[str], data_root: str) -> list[str]:
    """Return scenes on disk that are not the source of any row, for data sets that are open-ended.

    `data_root` is empty if not set.
    """
    open_ended = [DATASETS[name] for name in groups if is_open_ended(name)]
    available = [
        f"{dataset.name}/{scene}"
        for dataset in (open_ended if data_root else ())
        for scene in dataset.found(dataset.root(data_root))
    ]
    return [name for name in available if DATA_PREFIX + name not in sources]


def label_sets(source: str, data_root: str, row: str) -> tuple[str, ...]:
    """Return the label sets (`data set/scene`) of a row's scene (`dataset/scene`), those of its source first.

    Your own annotations are in `data_root` or in the working folder.

    Raises:
        SettingsError: they are in the working folder, but `data_root` has those of other scenes.
    """
    own_name = f"{ANNOTATED}/{row}"
    root = dataset_of(ANNOTATED).root(data_root).parent
    own_labels = (own_name,) if any((root / own_name).glob("*.json")) else ()
    if not own_labels and any(Path(own_name).glob("*.json")):
        raise SettingsError(
            f"the annotations in {own_name} are not scored, because {root} has a folder `annotated` too",
            fix=f"move {own_name} to {root / own_name}",
        )
    names = published(source)
    if names is None or absence(source, data_root) is not None:
        return own_labels
    name, scene = names
    others = [dataset for dataset in DATASETS.values() if dataset.images_of == name]
    more = [dataset.name for dataset in others if not dataset.missing(dataset.root(data_root), scene)]
    return (f"{name}/{scene}", *own_labels, *(f"{other}/{scene}" for other in more))


def label_files(labels: str, data_root: str) -> tuple[Path, ...]:
    """Return the sorted files of `data set/scene` that only evaluation reads; edits rerun only evaluation."""
    dataset, scene = scene_of(labels)
    root = dataset.root(data_root)
    files = {path for pattern in dataset.label_places(scene) for path in root.glob(pattern) if path.is_file()}
    return tuple(sorted(files))


def image_files(source: str, data_root: str) -> tuple[Path, ...]:
    """Return the data set's files from which a scene's images and poses are exported."""
    name = source.removeprefix(DATA_PREFIX)
    dataset, scene = scene_of(name)
    files, root = set[Path](), dataset.root(data_root)
    for folder in dataset.needs(root, scene):
        files.update(files_of(root / folder))
    return tuple(sorted(files.difference(label_files(name, data_root))))


def is_exported(source: str) -> bool:
    """Return whether images and poses must first be exported: true for data sets with labelled points."""
    names = published(source)
    return names is not None and dataset_of(names[0]).labels == "points"


def export_images(name: str, data_root: Path, out: Path) -> None:
    """Write the images and poses of `data set/scene` for the `poses` stage.

    For a labelled mesh, the vertices are also written (`points.ply`, without labels) as initial or frozen
    Gaussian positions. Lidar points are not written, because the sky and distant objects have none.

    Raises:
        SceneError: the scene's labels are on images, which need no export, or the scene cannot be read.
    """
    from hilsplat.datasets.points.labelled_points import PointScene
    from hilsplat.scene.posed_images import write_posed_images

    scene = open_labels(name, data_root)
    if not isinstance(scene, PointScene):
        raise SceneError(
            f"{name} needs no export: its images are already in a folder",
            fix="enter the folder as the source in the scene sheet",
        )
    meshes = [points for labelling, points in scene.truth.items() if labelling != "waymo"]
    for sentence in scene.warnings:
        logger.warning("%s: %s", name, sentence)
    write_posed_images(out, scene.images, meshes[0].xyz if meshes else None)
