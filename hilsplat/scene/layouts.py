"""Folder layouts of photographs and known poses. This module imports quickly, for workflow start-up."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import parse_json
from hilsplat.base.errors import SceneError
from hilsplat.base.files import list_images, regular

TRAINED = ("output", "outputs", "exports", "language_features")
"""Folders that 3DGS, nerfstudio and LangSplat write beside photographs."""

POSES_BOUNDS = "poses_bounds.npy"
"""Pose file of LLFF."""

NO_POSES = Path("none")
"""Value used instead of a path to ignore the poses in the folder."""

DATAPARSER = "dataparser_transforms.json"
"""File in which nerfstudio records the transform to its training coordinates."""

EXPORTED = ("exports/*/splat.ply", "exports/splat.ply", "splat.ply", "point_cloud.ply")
"""Paths of a PLY exported by nerfstudio or a viewer; a PLY written by 3DGS is preferred."""


def read_json_object(path: Path, fix: str) -> dict[str, Any]:
    """Read another program's JSON object; raise SceneError with the given fix if it cannot be read."""
    try:
        content = parse_json(regular(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SceneError(f"{path} is not valid JSON: {error}", fix=fix) from error
    if not isinstance(content, dict):
        raise SceneError(f"{path} is not a JSON object", found=type(content).__name__, fix=fix)
    return content


def trained_gaussians(folder: Path) -> Path | None:
    """Return the PLY that 3DGS, LangSplat or nerfstudio wrote to a folder after the most steps, or None.

    LangSplat's process.sh keeps 3DGS in `<scene>/<case>` and copies it to `<case>_1`, `_2` and `_3`, one for
    each level. Of equal numbers of steps, 3DGS's own PLY is preferred, then the first level's.
    """
    starts = ("output/*/", "output/", "*/", "")
    patterns = [f"{start}point_cloud/iteration_*/point_cloud.ply" for start in starts]
    found = {path for pattern in patterns for path in folder.glob(pattern)}

    def rank(path: Path) -> tuple[int, int, int, str]:
        steps = path.parent.name.partition("_")[2]
        level = langsplat_level(path)
        return int(steps) if steps.isdecimal() else 0, -(level or 0), path.stat().st_mtime_ns, str(path)

    others = [path for name in EXPORTED for path in sorted(folder.glob(name))]
    every = [*others, *sorted(found, key=rank)]
    return every[-1] if every else None


def langsplat_level(ply: Path) -> int | None:
    """Return the level (1, 2 or 3) of LangSplat for which a PLY written by its training was used, or None."""
    model = ply.parents[2].name if len(ply.parents) > 2 else ""
    siblings = [ply.parents[2].with_name(f"{model[:-1]}{level}") for level in (1, 2, 3)] if model else []
    is_level = model[-2:] in ("_1", "_2", "_3") and all(path.is_dir() for path in siblings)
    return int(model[-1]) if is_level else None


def dataparser_of(ply: Path, source: Path) -> Path | None:
    """Return the `DATAPARSER` file of a PLY trained by nerfstudio, or None for other PLYs.

    It is searched for in the PLY's folder and, if the PLY has nerfstudio's file name, in the source folder
    and the folder of the latest training run.
    """
    places = [ply.parent]
    if ply.name == "splat.ply":
        runs = sorted(source.glob(f"outputs/*/*/*/{DATAPARSER}"))  # the last folder is a timestamp
        places += [source, *(run.parent for run in runs[-1:])]
    return next((place / DATAPARSER for place in places if (place / DATAPARSER).is_file()), None)


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
    for place in (folder / "label", folder.parent / "label" / folder.name):
        if found := sorted(place.glob("*.json")):
            return found
    return []


def photo_folder(folder: Path) -> Path:
    """Return the folder of a source's photographs: the source, its `images/`, or a phone export's images."""
    if list_images(folder):
        return folder
    if (folder / "images").is_dir():
        return folder / "images"
    export = polycam_folders(folder) or record3d_export(folder)
    return export[0] if export else folder


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
    """

    root: Path
    kind: str
    files: tuple[Path, ...]


def find_known_poses(folder: Path, named: Path | None = None) -> KnownPoses | None:
    """Find poses from COLMAP, transforms files, LLFF, Polycam or Record3D, in this order, or return None.

    If `named` is a COLMAP model, a transforms file, or a folder with either, it is used instead of the poses
    in `folder`; `NO_POSES` ignores all poses.

    Raises:
        SceneError: there is a `sparse/` folder without a complete model, or `named` has no poses.
    """
    if named == NO_POSES:
        return None
    if named is not None:
        return _named_poses(folder, named)
    for place in ("sparse/0", "sparse"):
        if _is_model(folder / place):
            return KnownPoses(folder, "colmap", (folder / place,))
    for name in ("transforms.json", "transforms_train.json"):
        if (folder / name).is_file():
            files = [folder / name]
            if name == "transforms_train.json" and (folder / "transforms_test.json").is_file():
                files.append(folder / "transforms_test.json")
            return KnownPoses(folder, "transforms", tuple(files))
    if (folder / POSES_BOUNDS).is_file():
        return KnownPoses(folder, "llff", (folder / POSES_BOUNDS,))
    for kind, export in (("polycam", polycam_folders(folder)), ("record3d", record3d_export(folder))):
        if export is not None:
            return KnownPoses(folder, kind, export)
    if (folder / "sparse").is_dir():
        raise SceneError(
            f"{folder / 'sparse'} does not contain a complete COLMAP model",
            expected="cameras, images and points3D, all .bin or all .txt, in sparse/0/ or sparse/",
            found=", ".join(sorted(path.name for path in (folder / "sparse").rglob("*"))) or "nothing",
            fix="add the missing files, or rename sparse/ so that the poses are computed",
        )
    return None


def _named_poses(folder: Path, named: Path) -> KnownPoses:
    if named.is_file() and named.suffix == ".json":
        return KnownPoses(folder, "transforms", (named,))
    if _is_model(named):
        return KnownPoses(folder, "colmap", (named,))
    found = find_known_poses(named) if named.is_dir() else None
    if found is None or found.kind not in ("colmap", "transforms"):
        raise SceneError(
            f"{named} has no poses for {folder}",
            expected="a COLMAP model, a transforms.json, or a folder with either",
            fix="correct the path, or omit it to use the poses beside the images",
        )
    return KnownPoses(folder, found.kind, found.files)


def _is_model(folder: Path) -> bool:
    names = ("cameras", "images", "points3D")
    return any(all((folder / f"{name}{suffix}").is_file() for name in names) for suffix in (".bin", ".txt"))


def polycam_folders(folder: Path) -> tuple[Path, Path] | None:
    """Return a raw Polycam export's image and camera folders (corrected ones if present), or None."""
    for prefix in ("corrected_", ""):
        images, cameras = (folder / "keyframes" / f"{prefix}{what}" for what in ("images", "cameras"))
        if images.is_dir() and cameras.is_dir():
            return images, cameras
    return None


def record3d_export(folder: Path) -> tuple[Path, Path] | None:
    """Return the image folder and pose file of a Record3D export (images or unpacked .r3d), or None."""
    for metadata in (folder / "metadata.json", folder / "metadata"):
        for images in (folder / "rgb", folder / "rgbd"):
            if metadata.is_file() and images.is_dir():
                return images, metadata
    return None


def unwrapped(folder: Path) -> Path:
    """Return the folder with the actual files, because archives often wrap them in a single folder."""
    while photo_folder(folder) == folder and not list_images(folder) and not has_known_poses(folder):
        inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
        if len(inside) != 1 or not inside[0].is_dir():
            break
        folder = inside[0]
    return folder
