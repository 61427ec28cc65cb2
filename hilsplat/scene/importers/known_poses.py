"""Location of known poses in a folder, and the views they describe."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from hilsplat.base.errors import SceneError
from hilsplat.base.rotations import RIGID_TOLERANCE, are_rotations
from hilsplat.scene.cameras import MAX_SIDE_PX
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.layouts import (
    MODELS,
    NO_POSES,
    POSES_BOUNDS,
    TRANSFORMS,
    polycam_folders,
    record3d_export,
)

MODEL_FILES = ("cameras", "images", "points3D")


@dataclass(frozen=True)
class KnownPoses:
    """Location of the poses of a folder.

    Attributes:
        root: folder of the images.
        kind: "colmap", "transforms", "llff", "polycam" or "record3d".
        files: COLMAP's model folder; the transforms files (training, then test); LLFF's file; Polycam's
            folders of images and cameras; or Record3D's image folder and pose file.
    """

    root: Path
    kind: str
    files: tuple[Path, ...]


@dataclass(frozen=True)
class KnownView:
    """A posed view as described by its source, before its image is read.

    Attributes:
        image: its file, or None if missing.
        camera: its lens, for the image size stated by the source.
        cam_from_source: world-to-camera transform, OpenCV axes.
        border_px: width of a blank border to crop, px of the camera.
    """

    name: str
    image: Path | None
    camera: pycolmap.Camera
    cam_from_source: Float64[np.ndarray, "4 4"]
    is_test: bool = False
    border_px: int = 0


def checked(views: list[KnownView], known: KnownPoses) -> list[KnownView]:
    """Return the views; refuse an invalid lens or pose, and three or more views with the same pose."""
    for view in views:
        values = np.array([*view.camera.params, view.camera.width, view.camera.height], np.float64)
        focal = [view.camera.params[row] for row in view.camera.focal_length_idxs()]
        pose = view.cam_from_source
        is_size = (values[-2:] > 0).all() and (values[-2:] <= MAX_SIDE_PX).all()
        if not np.isfinite(values).all() or min(focal, default=0) <= 0 or not is_size:
            fault, found = "lens", f"{view.camera.model_name} {values.tolist()}"
        elif not np.isfinite(pose).all() or not are_rotations(pose[:3, :3], RIGID_TOLERANCE):
            fault, found = "rotation", np.array2string(pose[:3, :3], precision=4).replace("\n", "")
        elif np.abs(pose[:3, 3]).max() > FARTHEST:
            fault, found = "position", str(pose[:3, 3].tolist())
        else:
            continue
        raise SceneError(
            f"the {fault} of {view.name} cannot be that of a camera",
            expected=EXPECTED[fault],
            found=found,
            fix=f"export the poses again: {known.files[0]}",
        )
    poses = np.stack([view.cam_from_source for view in views]) if views else np.zeros((0, 4, 4))
    if len(views) > 2 and np.allclose(poses, poses[0]):
        raise SceneError(
            f"all {len(views)} views of {known.files[0]} have the same pose", fix="export the poses again"
        )
    return views


EXPECTED = {
    "lens": f"finite numbers, a focal length above 0, sides of 1 to {MAX_SIDE_PX} px",
    "rotation": "a matrix that neither scales nor mirrors, from a quaternion that is not 0",
    "position": "coordinates up to 1e9",
}
FARTHEST = 1e9
"""Largest coordinate, in the source's units, up to which 32-bit numbers can resolve a scene."""


def find_known_poses(folder: Path, named: Path | None = None) -> KnownPoses | None:
    """Search for poses of COLMAP, transforms files, LLFF, Polycam and Record3D, in this order; None if none.

    Args:
        named: a COLMAP model, a transforms file, or a folder with either, used instead of the poses in
            `folder`; `layouts.NO_POSES` to ignore all poses.

    Raises:
        SceneError: there is a `sparse/` folder without a complete model, or `named` has no poses.
    """
    folder = Path(folder)
    if named == NO_POSES:
        return None
    if named is not None:
        return _named_poses(folder, named)
    for place in MODELS:
        if _is_model(folder / place):
            return KnownPoses(folder, "colmap", (folder / place,))
    for name in TRANSFORMS:
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
            f"{folder / 'sparse'} does not hold a complete COLMAP model",
            expected="cameras, images and points3D, all .bin or all .txt, in sparse/0/ or sparse/",
            found=", ".join(sorted(path.name for path in (folder / "sparse").rglob("*"))) or "nothing",
            fix="complete the model, or rename sparse/ to have the poses computed",
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
            fix="correct the path, or leave it out to use what is beside the images",
        )
    return KnownPoses(folder, found.kind, found.files)


def _is_model(folder: Path) -> bool:
    return any(
        all((folder / f"{name}{suffix}").is_file() for name in MODEL_FILES) for suffix in (".bin", ".txt")
    )
