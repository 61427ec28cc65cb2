"""How folders of photographs are laid out; light enough to import at the start of the workflow."""

from pathlib import Path

from hilsplat.base.files import list_images

TRAINED = ("output", "outputs", "exports", "language_features")
"""Folders beside photographs that 3DGS, nerfstudio and LangSplat write."""

MODELS = ("sparse/0", "sparse")
"""Folders of COLMAP's model, in order of preference."""

TRANSFORMS = ("transforms.json", "transforms_train.json")
"""Files with poses that nerfstudio and others write, in order of preference."""

NO_POSES = Path("none")
"""In place of a path: poses that a folder brings are not used."""

DATAPARSER = "dataparser_transforms.json"
"""nerfstudio's record of the coordinates in which it trained."""


EXPORTED = ("exports/*/splat.ply", "exports/splat.ply", "splat.ply", "point_cloud.ply")
"""Places of a PLY that nerfstudio or a viewer exported; one of 3DGS's own is preferred."""


def trained_gaussians(folder: Path) -> Path | None:
    """Return the PLY that 3DGS or nerfstudio trained in a folder: of several, that of the most steps."""
    found = [
        path
        for pattern in (
            "output/*/point_cloud/iteration_*",
            "output/point_cloud/iteration_*",
            "point_cloud/iteration_*",
        )
        for path in Path(folder).glob(f"{pattern}/point_cloud.ply")
    ]
    found.sort(key=lambda path: (int(path.parent.name.partition("_")[2] or 0), path.stat().st_mtime_ns))
    others = [path for name in EXPORTED for path in sorted(Path(folder).glob(name))]
    return [*others, *found][-1] if others or found else None


def dataparser_of(ply: Path, source: Path) -> Path | None:
    """Return the record of the coordinates of nerfstudio's PLY, or None for a PLY of another program.

    It is in the PLY's folder, in the source's folder, or in that of the latest training run. The last two
    count only for a PLY with the name that nerfstudio gives.
    """
    places = [ply.parent]
    if ply.name == "splat.ply":
        runs = sorted(Path(source).glob(f"outputs/*/*/*/{DATAPARSER}"))  # the last part is the time
        places += [Path(source), *(run.parent for run in runs[-1:])]
    return next((place / DATAPARSER for place in places if (place / DATAPARSER).is_file()), None)


def transforms_of(folder: Path, named: Path | None = None) -> Path | None:
    """Return the transforms file that poses a folder; None if a COLMAP model does, or nothing of the kind."""
    if named is not None and named.suffix == ".json":
        return named
    folder = named or folder
    if (folder / "sparse").is_dir():
        return None
    found = (path for path in map(folder.joinpath, TRANSFORMS) if path.is_file())
    return next(found, None)


def langsplat_features(folder: Path) -> Path | None:
    """Return the folder of masks and CLIP vectors that LangSplat's preprocessing wrote."""
    features = Path(folder) / "language_features"
    return features if any(features.glob("*_s.npy")) else None


def label_files(folder: Path) -> list[Path]:
    """Return the label files of a scene of LERF-OVS: in its `label/`, or in the one beside the scene."""
    folder = Path(folder).resolve()
    for place in (folder / "label", folder.parent / "label" / folder.name):
        if found := sorted(place.glob("*.json")):
            return found
    return []


def photo_folder(folder: Path) -> Path:
    """Where the photographs of a source are: the folder itself or, if it has none, where exports put them."""
    folder = Path(folder)
    if list_images(folder):
        return folder
    if (folder / "images").is_dir():
        return folder / "images"
    if (polycam := polycam_folders(folder)) is not None:
        return polycam[0]
    if (record3d := record3d_export(folder)) is not None:
        return record3d[0]
    return folder


def has_known_poses(folder: Path, named: Path | None = None) -> bool:
    """Whether a folder has poses in a form that `find_known_poses` finds, or others are named."""
    if named is not None:
        return named != NO_POSES
    return (
        (folder / "sparse").is_dir()
        or any(folder.glob("transforms*.json"))
        or (folder / "poses_bounds.npy").is_file()
        or polycam_folders(folder) is not None
        or record3d_export(folder) is not None
    )


def polycam_folders(folder: Path) -> tuple[Path, Path] | None:
    """Folders of images and of cameras in a raw Polycam export, the corrected ones if there are any."""
    for prefix in ("corrected_", ""):
        images, cameras = (folder / "keyframes" / f"{prefix}{what}" for what in ("images", "cameras"))
        if images.is_dir() and cameras.is_dir():
            return images, cameras
    return None


def record3d_export(folder: Path) -> tuple[Path, Path] | None:
    """Folder of images and file of poses in a Record3D export: an image sequence, or an unpacked .r3d."""
    for metadata in (folder / "metadata.json", folder / "metadata"):
        for images in (folder / "rgb", folder / "rgbd"):
            if metadata.is_file() and images.is_dir():
                return images, metadata
    return None


def unwrapped(folder: Path) -> Path:
    """The folder that holds something: archives often wrap their content in a folder of its own."""
    while photo_folder(folder) == folder and not list_images(folder) and not has_known_poses(folder):
        inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
        if len(inside) != 1 or not inside[0].is_dir():
            break
        folder = inside[0]
    return folder
