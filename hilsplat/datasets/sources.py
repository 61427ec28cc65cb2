"""Rows of the scene sheet that name a published data set: what is present of it, and which files hold its
labels.

The workflow uses this module at start-up, so it reads no data and imports nothing heavy at the top.
"""

from collections.abc import Collection
from pathlib import Path

from hilsplat.base.errors import SceneError

DATA_PREFIX = "data:"

LABELS_ON: dict[str, tuple[str, ...]] = {"lerf_ovs": ("hi_lerf",), "3d_ovs": ("hi_3dovs",)}
"""Data sets that label the images of another one, in addition to its own labels."""

LEVELLED = tuple(name for names in LABELS_ON.values() for name in names)
"""Those data sets; their labels have levels."""


def published(source: str) -> tuple[str, str] | None:
    """Data set and scene of a source such as `data:lerf_ovs/figurines`; None for anything else."""
    from hilsplat.datasets.registry import DATASETS

    name, _, scene = source.removeprefix(DATA_PREFIX).partition("/")
    return (name, scene) if source.startswith(DATA_PREFIX) and scene and name in DATASETS else None


def absence(source: str, data_root: str) -> str | None:
    """Why a `data:` source cannot be used, as one sentence; None if it can.

    Args:
        source: of a row of the scene sheet.
        data_root: folder of the data sets; empty if not set.
    """
    if not source.startswith(DATA_PREFIX):
        return None
    if not data_root:
        return "data_root is not set"
    root = Path(data_root).expanduser()
    place = published(source)
    if place is None:
        folder = root / source.removeprefix(DATA_PREFIX)
        return None if folder.is_dir() else f"{folder} is missing"
    from hilsplat.datasets.registry import dataset_of

    dataset = dataset_of(place[0])
    try:
        dataset.require(dataset.locate(root), place[1])
    except SceneError as error:
        return _one_line(error)
    return None


def unlisted(sources: Collection[str], groups: Collection[str], data_root: str) -> list[str]:
    """Return scenes on disk that no row lists, of data sets whose scenes differ between users (Waymo).

    Args:
        sources: of all rows of the scene sheet.
        groups: groups that are run; such a data set has the name of its group.
        data_root: folder of the data sets; empty if not set.
    """
    from hilsplat.datasets.registry import DATASETS, dataset_of

    open_ended = [dataset_of(name) for name in groups if data_root and name in DATASETS]
    found = [
        f"{dataset.name}/{scene}"
        for dataset in open_ended
        if not dataset.scenes
        for scene in dataset.found(Path(data_root).expanduser() / dataset.folder)
    ]
    return [name for name in found if DATA_PREFIX + name not in sources]


def label_sets(source: str, data_root: str, row: str) -> tuple[str, ...]:
    """Labels that a scene can be scored against, as `data set/scene`, its own first; none if the data is
    missing.

    Args:
        source: of a row of the scene sheet.
        data_root: folder of the data sets; empty: the working folder, which may hold your own annotations.
        row: name of the row, `dataset/scene`.
    """
    own = (f"annotated/{row}",) if any((_root(data_root) / "annotated" / row).glob("*.json")) else ()
    place = published(source)
    if place is None or absence(source, data_root) is not None:
        return own
    from hilsplat.datasets.registry import dataset_of

    name, scene = place
    found = [f"{name}/{scene}", *own]
    for other in LABELS_ON.get(name, ()):
        dataset = dataset_of(other)
        folder = Path(data_root).expanduser() / dataset.folder
        if not dataset.missing(folder, scene):
            found.append(f"{other}/{scene}")
    return tuple(found)


def _root(data_root: str) -> Path:
    return Path(data_root).expanduser()


def label_files(labels: str, data_root: str) -> tuple[Path, ...]:
    """Files of `data set/scene` that only evaluation reads, sorted: editing one reruns nothing else."""
    from hilsplat.datasets.registry import dataset_of

    name, _, scene = labels.partition("/")
    dataset = dataset_of(name)
    root = _root(data_root) / dataset.folder
    files: list[Path] = []
    for pattern in dataset.label_places(scene):
        files += [path for path in root.glob(pattern) if path.is_file()]
    return tuple(sorted(set(files)))


def image_files(source: str, data_root: str) -> tuple[Path, ...]:
    """Files from which the images and poses of an exported scene are read, as far as the data set names
    them."""
    from hilsplat.datasets.registry import dataset_of

    place = published(source)
    assert place is not None, source
    name, scene = place
    dataset = dataset_of(name)
    root = Path(data_root).expanduser() / dataset.folder
    labels = set(label_files(f"{name}/{scene}", data_root))
    files: set[Path] = set()
    for required in dataset.required(scene):
        path = root / required
        files |= {file for file in path.rglob("*") if file.is_file()} if path.is_dir() else {path}
    return tuple(sorted(file for file in files - labels if file.is_file()))


def is_exported(source: str) -> bool:
    """Whether images and poses must first be exported from the data set's own files, as with labels on
    points."""
    place = published(source)
    if place is None:
        return False
    from hilsplat.datasets.registry import dataset_of

    return dataset_of(place[0]).labels == "points"


def export_images(name: str, data_root: Path, out: Path) -> int:
    """Write images and poses of a scene with labelled points as a folder that `poses` imports.

    The vertices of a labelled mesh are written too, without their labels: Gaussians start there, and may be
    frozen there. Lidar points are not written, since the sky and everything far away has none.

    Args:
        name: `data set/scene`.
        data_root: folder of the data sets.
        out: folder with `images/`, `transforms.json` and perhaps `points.ply`.

    Returns:
        the number of images.

    Raises:
        SceneError: the scene's labels are on images, which need no export, or it cannot be read.
    """
    from hilsplat.datasets.points.labelled_points import PointScene
    from hilsplat.datasets.registry import open_labels
    from hilsplat.scene.posed_images import write_posed_images

    scene = open_labels(name, data_root)
    if not isinstance(scene, PointScene):
        raise SceneError(
            f"{name} needs no export: its images are already in a folder",
            fix="name the folder as source in the scene sheet",
        )
    meshes = [points for points in scene.truth.values() if points.faces is not None]
    write_posed_images(out, scene.images, meshes[0].xyz if meshes else None)
    return len(scene.images)


def _one_line(error: SceneError) -> str:
    """A message as one line, for a log or a footnote."""
    return "; ".join(" ".join(line.split()) for line in str(error).splitlines())
