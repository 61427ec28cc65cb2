"""Folder layouts of photographs and known poses. This module imports quickly, for workflow start-up."""

import re
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import parse_json
from hilsplat.base.errors import HilsplatError, SceneError, first_line
from hilsplat.base.files import IMAGE_SUFFIXES, list_images, regular
from hilsplat.base.lineage import visible_files

TRAINED = ("output", "outputs", "exports", "language_features")
"""Folders that 3DGS, nerfstudio and LangSplat write beside photographs."""

MAPS = ("label", "segmentations", "test_mask", "mask", "masks", "depth", "depths", "normals")
"""Folders of labels and maps, whose files are named after the photographs. Scaled copies are in `masks_4`."""

UNUSED = (*TRAINED, *MAPS)
"""Folders beside photographs whose images `poses` reads only if a pose names them with their folder."""

PHOTO_FOLDERS = ("images", "input")
"""Folders of photographs: COLMAP's and nerfstudio's, then that of 3DGS's `convert.py`."""

POSES_BOUNDS = "poses_bounds.npy"
"""Pose file of LLFF."""

NO_POSES = Path("none")
"""Value used instead of a path to ignore the poses in the folder."""

DATAPARSER = "dataparser_transforms.json"
"""File in which nerfstudio records the transform to its training coordinates."""

EXPORTED = ("exports/*/splat.ply", "exports/splat.ply", "splat.ply", "point_cloud.ply")
"""Paths of a PLY exported by nerfstudio or a viewer; a PLY written by 3DGS is preferred."""

HEADER_BYTES = 2**14  # number of bytes that are searched for the vertex count


def read_json_object(path: Path, fix: str) -> dict[str, Any]:
    """Read another program's JSON object; raise SceneError with the given fix if it cannot be read."""
    try:
        content = parse_json(regular(path).read_text(encoding="utf-8-sig"))
    except Exception as error:
        raise SceneError(f"{path} is not valid JSON: {first_line(error)}", fix=fix) from error
    if not isinstance(content, dict):
        raise SceneError(f"{path} is not a JSON object", found=type(content).__name__, fix=fix)
    return content


def vertex_count(path: Path) -> int | None:
    """Return the number of Gaussians in a PLY's header; None if unreadable (its reader says so)."""
    try:
        with regular(Path(path)).open("rb") as stream:
            header = stream.read(HEADER_BYTES)
    except OSError:
        return None
    match = re.search(rb"^element vertex ([0-9]+)\s*$", header, re.MULTILINE)
    return int(match[1]) if match else None


def trained_gaussians(folder: Path) -> list[Path]:
    """Return the PLYs that 3DGS, LangSplat, nerfstudio or a viewer wrote to a folder, best first.

    3DGS's come first, by number of steps; names without a number, such as `iteration_best`, are last. Then
    come those in `EXPORTED`. Among equals, the newest is preferred. LangSplat's process.sh keeps 3DGS in
    `<scene>/<case>` and copies it to `<case>_1`, `_2` and `_3`, one for each level. Of equal numbers of
    steps, 3DGS's own PLY is preferred, then the first level's.
    """
    starts = ("output/*/", "output/", "*/", "")
    patterns = [*EXPORTED, *(f"{start}point_cloud/iteration_*/point_cloud.ply" for start in starts)]
    pattern_of = {
        path: min(number, len(EXPORTED))
        for number, pattern in enumerate(patterns)
        for path in folder.glob(pattern)
        if path.is_file()
    }

    def rank(path: Path) -> tuple[int, int, int, str, str]:
        iteration = re.fullmatch(r"iteration_(\d+)", path.parent.name)
        steps = int(iteration[1]) if iteration else -1
        return pattern_of[path], steps, -(langsplat_level(path) or 0), _written(path), str(path)

    return sorted(pattern_of, key=rank, reverse=True)


def _written(path: Path) -> str:
    """Return a timestamp for comparisons: the one that a file's folder is named after, or else the file's."""
    if re.fullmatch(r"\d{4}-\d\d-\d\d\w*", path.parent.name):
        return path.parent.name
    time_s, ns = divmod(path.stat().st_mtime_ns if path.exists() else 0, 10**9)
    return time.strftime("%Y-%m-%d_%H%M%S", time.localtime(time_s)) + f".{ns:09}"


def langsplat_level(ply: Path) -> int | None:
    """Return the level (1, 2 or 3) of LangSplat for which a PLY written by its training was used, or None."""
    model = ply.parents[2].name if len(ply.parents) > 2 else ""
    siblings = [ply.parents[2].with_name(f"{model[:-1]}{level}") for level in (1, 2, 3)] if model else []
    is_level = model[-2:] in ("_1", "_2", "_3") and all(path.is_dir() for path in siblings)
    return int(model[-1]) if is_level else None


def dataparser_of(ply: Path, source: Path) -> Path | None:
    """Return the `DATAPARSER` file of a PLY trained by nerfstudio, or None for other PLYs.

    It is searched for in the PLY's folder and, if the PLY has nerfstudio's file name, in the folder above it,
    the source folder, and the folder of the latest training run that began before the PLY was written. If no
    run did, the PLY's time is that of a copy, and the latest run is used.
    """
    candidates = [ply.parent / DATAPARSER]
    if ply.name == "splat.ply":
        runs = sorted(source.glob(f"outputs/*/*/*/{DATAPARSER}"), key=_written)
        earlier = [run for run in runs if _written(run) <= _written(ply)]
        candidates += [ply.parent.parent / DATAPARSER, source / DATAPARSER, *(earlier or runs)[-1:]]
    return next((path for path in candidates if path.is_file()), None)


def transforms_of(folder: Path, named: Path | None = None) -> Path | None:
    """Return the transforms file if `find_known_poses` selects one for a folder, else None."""
    known = find_known_poses(folder, named)
    return known.files[0] if known is not None and known.kind == "transforms" else None


def langsplat_features(folder: Path) -> Path | None:
    """Return the folder of masks and CLIP vectors written by LangSplat's preprocessing, or None."""
    features = folder / "language_features"
    return features if any(features.glob("*_s.npy")) else None


def label_files(folder: Path) -> list[Path]:
    """Return the label files of a LERF-OVS scene, from its `label/` folder or the one beside the scene."""
    folder = folder.resolve()
    beside = folder.parent / "label" / folder.name
    return sorted((folder / "label").glob("*.json")) or sorted(beside.glob("*.json"))


def photo_folder(folder: Path) -> Path:
    """Return the folder of a source's photographs.

    It is the source itself or, if that has fewer images, its `images/` or `input/` (in any case); else a
    phone export's images; else the only folder with images up to two levels below. Of several such folders,
    none is chosen (`folders_with_images` lists them).
    """
    num_images = len(list_images(folder))
    for name in PHOTO_FOLDERS:
        for below in sorted(folder.iterdir()):
            if below.name.lower() == name and below.is_dir() and len(list_images(below)) > num_images:
                return below
    if num_images:
        return folder
    if export := polycam_folders(folder) or record3d_export(folder):
        return export[0]
    folders = folders_with_images(folder)
    return next(iter(folders)) if len(folders) == 1 else folder


def images_below(folder: Path) -> list[Path]:
    """Return the images in a folder and its subfolders, as `visible_files` does."""
    return [path for path in visible_files(folder) if path.suffix.lower() in IMAGE_SUFFIXES]


def used_images(folder: Path) -> list[Path]:
    """Return the images in a folder and its subfolders, without those in `UNUSED` ones."""
    return [
        path
        for path in images_below(folder)
        if re.sub(r"_\d$", "", path.relative_to(folder).parts[0].lower()) not in UNUSED
    ]


def folders_with_images(folder: Path) -> dict[Path, int]:
    """Return the number of images of each folder with images, up to two levels below a source."""
    counts = Counter(path.parent for path in images_below(folder))
    return {
        below: count
        for below, count in sorted(counts.items())
        if 1 <= len(parts := below.relative_to(folder).parts) <= 2 and not set(parts) & set(TRAINED)
    }


def contents(folder: Path) -> str:
    """Return what a folder without usable photographs contains, for messages."""
    kinds = Counter(file.suffix.lower() or "no suffix" for file in folder.iterdir() if file.is_file())
    items = [f"{count} files ({kind})" for kind, count in sorted(kinds.items())]
    items += [f"{count} images in {below}/" for below, count in folders_with_images(folder).items()]
    return ", ".join(items[:8]) or "nothing"


def has_known_poses(folder: Path, named: Path | None = None) -> bool:
    """Return whether poses are given or in the folder, even if `find_known_poses` refuses them."""
    try:
        return find_known_poses(folder, named) is not None
    except SceneError:
        return True


@dataclass(frozen=True)
class KnownPoses:
    """Location of the poses for a folder's images.

    Attributes:
        root: folder of the images.
        kind: "colmap", "transforms", "llff", "polycam" or "record3d".
        files: COLMAP's model folder; the transforms files (training, then test); LLFF's file; Polycam's
            folders of images and cameras; or Record3D's image folder and pose file.
        others: what else in the folder has poses, and is not used.
    """

    root: Path
    kind: str
    files: tuple[Path, ...]
    others: tuple[Path, ...] = ()


def find_known_poses(folder: Path, named: Path | None = None) -> KnownPoses | None:
    """Find poses from COLMAP, transforms files, LLFF, Polycam or Record3D, in this order, or return None.

    Of several COLMAP models, the one with the most images is taken. If `named` is a COLMAP model, a
    transforms file, or a folder with either, it is used instead of the poses in `folder`; `NO_POSES` ignores
    all poses.

    Raises:
        SceneError: there is a `sparse/` folder without a complete model, or `named` has no poses.
    """
    if named == NO_POSES:
        return None
    if named is not None:
        return _named_poses(folder, named)
    poses: list[tuple[str, tuple[Path, ...]]] = [("colmap", (model,)) for model in colmap_models(folder)]
    if (folder / "transforms.json").is_file():
        poses.append(("transforms", (folder / "transforms.json",)))
    if (folder / "transforms_train.json").is_file():
        held_out = [folder / f"transforms_{split}.json" for split in ("test", "val")]
        tests = [path for path in held_out if path.is_file()]
        poses.append(("transforms", (folder / "transforms_train.json", *tests[:1])))
    if (folder / POSES_BOUNDS).is_file():
        poses.append(("llff", (folder / POSES_BOUNDS,)))
    exports = (("polycam", polycam_folders(folder)), ("record3d", record3d_export(folder)))
    poses += [(kind, export) for kind, export in exports if export is not None]
    if poses:
        (kind, files), *others = poses
        return KnownPoses(folder, kind, files, tuple(paths[-1] for _, paths in others))
    if (folder / "sparse").is_dir():
        raise SceneError(
            f"{folder / 'sparse'} does not contain a complete COLMAP model",
            expected="cameras and images, both .bin or both .txt, in sparse/ or a folder in it",
            found=", ".join(sorted(path.name for path in (folder / "sparse").rglob("*"))) or "nothing",
            fix="add the missing files, or rename sparse/ so that the poses are computed",
        )
    return None


def _named_poses(folder: Path, named: Path) -> KnownPoses:
    if named.is_file() and named.suffix == ".json":
        return KnownPoses(folder, "transforms", (named,))
    if model_files(named):
        return KnownPoses(folder, "colmap", (named,))
    known = find_known_poses(named) if named.is_dir() else None
    if known is None or known.kind not in ("colmap", "transforms"):
        raise SceneError(
            f"{named} has no poses for {folder}",
            expected="a COLMAP model, a transforms.json, or a folder with either",
            fix="correct the path, or omit it to use the poses beside the images",
        )
    return replace(known, root=folder)


def model_files(folder: Path) -> list[Path]:
    """Return the files of the COLMAP model in a folder: cameras, images and, if present, points."""
    for suffix in (".bin", ".txt"):
        cameras, images, points = (folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D"))
        if cameras.is_file() and images.is_file():
            return [cameras, images, *([points] if points.is_file() else [])]
    return []


def colmap_models(folder: Path) -> list[Path]:
    """Return the folders of the COLMAP models in `sparse/`, those with the most images first."""
    folders = [*sorted((folder / "sparse").glob("*/")), folder / "sparse"]
    return sorted((model for model in folders if model_files(model)), key=lambda model: -_num_images(model))


def _num_images(model: Path) -> int:
    """Return the number of images that a COLMAP model declares; 0 if it is damaged (its reader says so)."""
    images = model_files(model)[1]
    with suppress(OSError, HilsplatError):
        if images.suffix == ".txt":
            return len(IMAGE_LINE.findall(regular(images).read_bytes()))
        with regular(images).open("rb") as stream:
            return int.from_bytes(stream.read(8), "little")
    return 0


IMAGE_LINE = re.compile(rb"^ *\d+( +[-+.\deE]+){7} +\d+ +[^ \r\n]", re.MULTILINE)
"""A line of images.txt with id, pose, camera and name."""


def polycam_folders(folder: Path) -> tuple[Path, Path] | None:
    """Return a raw Polycam export's image and camera folders (corrected ones if not empty), or None."""
    for prefix in ("corrected_", ""):
        images, cameras = (folder / "keyframes" / f"{prefix}{what}" for what in ("images", "cameras"))
        if images.is_dir() and any(cameras.glob("*.json")):
            return images, cameras
    return None


def record3d_export(folder: Path) -> tuple[Path, Path] | None:
    """Return the image folder and pose file of a Record3D export (images or unpacked .r3d), or None."""
    for metadata in (folder / "metadata.json", folder / "metadata"):
        for images in (folder / "rgb", folder / "rgbd"):
            if metadata.is_file() and images.is_dir():
                return images, metadata
    return None


def photo_files(folder: Path, named: Path | None = None) -> list[Path]:
    """Return the files in a source folder that `poses` reads: photographs, and the files of known poses.

    Poses may refer to any image below the folder. Folders that hilsplat wrote and `UNUSED` ones are skipped.
    """
    try:
        known = find_known_poses(folder, named)
    except SceneError:  # `poses` reports it
        known = KnownPoses(folder, "", (folder / "sparse",))
    if known is None:
        return [path for path in list_images(photo_folder(folder)) if path.is_file()]
    files = set() if known.kind in ("polycam", "record3d") else set(used_images(known.root))
    for path in known.files:
        files.update(visible_files(path) if path.is_dir() else [path])
        if known.kind == "transforms":
            with suppress(SceneError):
                points = str(read_json_object(path, "").get("ply_file_path", ""))
                files.add(path.parent / points.replace("\\", "/"))
    return sorted(path for path in files if path.is_file())


def unwrapped(folder: Path) -> Path:
    """Return the folder with the actual files, because archives often wrap them in a single folder."""
    while not list_images(folder) and not has_known_poses(folder):
        inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
        if len(inside) != 1 or not inside[0].is_dir() or inside[0].name.lower() in PHOTO_FOLDERS:
            break
        folder = inside[0]
    return folder
