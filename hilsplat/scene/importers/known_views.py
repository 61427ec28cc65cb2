"""Readers of posed views: COLMAP, transforms.json (nerfstudio, Blender), LLFF, Polycam, Record3D.

All readers raise SceneError if a file cannot be used. The layouts and axes of phone exports match those in
nerfstudio's `polycam_utils.py`, `record3d_utils.py` and `process_data.py`.
"""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.artifacts import read_npy
from hilsplat.base.errors import ArtifactError, SceneError
from hilsplat.base.files import IMAGE_SUFFIXES, list_images
from hilsplat.base.images import opened_image
from hilsplat.base.rotations import RIGID_TOLERANCE, are_rotations
from hilsplat.scene.cameras import MAX_SIDE_PX
from hilsplat.scene.colmap import Points, camera_of, pose_matrix, pycolmap, reprojection_errors, sparse_points
from hilsplat.scene.importers.model_files import require_whole_files
from hilsplat.scene.layouts import KnownPoses, read_json_object
from hilsplat.scene.posed_images import OPENGL_TO_OPENCV, rigid_pose

AGAIN = "export it again"

FARTHEST = 1e9
"""Maximum coordinate, in the source's units; beyond it, 32-bit numbers are too coarse."""

MAX_VIEWS = 300
"""Maximum number of views used from a phone export, sampled evenly: a recording has many more frames than a
scene needs (nerfstudio: 300 for Record3D, 600 for Polycam)."""

POLYCAM_BORDER_PX = 15
"""Width of black borders left by undistortion in corrected images (nerfstudio: `crop_border_pixels`)."""

Z_UP_FROM_Y_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""ARKit's world has y up; scenes here have z up. This is a cyclic permutation, so nothing is mirrored."""


@dataclass(frozen=True)
class KnownView:
    """A posed view as described by its source, before its image is read.

    Attributes:
        image: image file, or None if missing.
        camera: lens for the image size stated by the source.
        cam_from_source: world-to-camera transform, OpenCV axes.
        border_px: width of a blank border to crop, px of the camera.
        report: number of observations and mean reprojection error, if the source has observations.
    """

    name: str
    image: Path | None
    camera: pycolmap.Camera
    cam_from_source: Float64[np.ndarray, "4 4"]
    is_test: bool = False
    border_px: int = 0
    report: dict[str, Any] = field(default_factory=dict)


def read_source(known: KnownPoses) -> tuple[list[KnownView], Points | None]:
    """Read the posed views of a folder in any supported format, with points if available."""
    if known.kind in ("colmap", "transforms"):
        views, points = (read_colmap if known.kind == "colmap" else read_transforms)(known)
        if points is not None and (bad := int((~np.isfinite(points[0]).all(axis=1)).sum())):
            raise SceneError(f"{bad} points of {known.files[0]} are not finite", fix=AGAIN)
        return views, points
    readers = {"polycam": read_polycam, "record3d": read_record3d, "llff": read_llff}
    return checked(readers[known.kind](known), known), None


def checked(views: list[KnownView], known: KnownPoses) -> list[KnownView]:
    """Return the views; refuse invalid lenses and poses, and three or more views that all share one pose."""
    for view in views:
        values = np.array([*view.camera.params, view.camera.width, view.camera.height], np.float64)
        focal = [view.camera.params[row] for row in view.camera.focal_length_idxs()]
        pose = view.cam_from_source
        is_size = (values[-2:] > 0).all() and (values[-2:] <= MAX_SIDE_PX).all()
        if not np.isfinite(values).all() or min(focal, default=0) <= 0 or not is_size:
            fault, found = "lens", f"{view.camera.model_name} {values.tolist()}"
            expected = f"finite numbers, a focal length above 0, sides of 1 to {MAX_SIDE_PX} px"
        elif not np.isfinite(pose).all() or not are_rotations(pose[:3, :3], RIGID_TOLERANCE):
            fault, found = "rotation", np.array2string(pose[:3, :3], precision=4).replace("\n", "")
            expected = "a matrix that neither scales nor mirrors, or a quaternion that is not 0"
        elif np.abs(pose[:3, 3]).max() > FARTHEST:
            fault, found, expected = "position", str(pose[:3, 3].tolist()), "coordinates up to 1e9"
        else:
            continue
        raise SceneError(
            f"the camera {fault} of view {view.name} is not valid",
            expected=expected,
            found=found,
            fix=f"export the poses again: {known.files[0]}",
        )
    poses = np.stack([view.cam_from_source for view in views]) if views else np.zeros((0, 4, 4))
    if len(views) > 2 and np.allclose(poses, poses[0]):
        raise SceneError(f"all {len(views)} views of {known.files[0]} have the same pose", fix=AGAIN)
    return views


def read_colmap(known: KnownPoses) -> tuple[list[KnownView], Points]:
    """Read a COLMAP model."""
    folder = known.files[0]
    require_whole_files(folder)
    try:
        model = pycolmap.Reconstruction(folder)
        views, errors = [], reprojection_errors(model)
        images = (model.images[image_id] for image_id in model.reg_image_ids())
        for image in sorted(images, key=lambda image: image.name):
            file, camera = _find_image(known.root, image.name), camera_of(image)
            pose, px = pose_matrix(image.cam_from_world()), errors[image.name]
            mean = round(float(px.mean()), 4) if len(px) else None
            report = {"observations": len(px), "reprojection_error_px": mean}
            views.append(KnownView(image.name, file, camera, pose, report=report))
        points = sparse_points(model)
    except (ValueError, RuntimeError, IndexError) as error:  # also raised for references to missing entries
        raise SceneError(f"the COLMAP model in {folder} cannot be read: {error}", fix=AGAIN) from error
    return checked(views, known), points


def _find_image(root: Path, name: str) -> Path | None:
    """Find an image by the name in the pose file, with or without a suffix, in `root` or its `images/`."""
    _check_inside(root, name)
    for base in (root / "images", root):
        for suffix in ("", *sorted(IMAGE_SUFFIXES)):
            if (image := base / f"{name}{suffix}").is_file():
                return image
    return None


def _check_inside(root: Path, name: str) -> None:
    """Refuse paths outside the source folder, so that downloaded data cannot access other files."""
    if Path(name).is_absolute() or Path(os.path.normpath(name)).parts[:1] == ("..",):
        raise SceneError(
            f"the poses in {root} refer to a file outside it: {name}",
            expected="paths inside the folder",
            fix="put the images into the folder, and correct the names in the pose file",
        )


def read_transforms(known: KnownPoses) -> tuple[list[KnownView], Points | None]:
    """Read transforms files: camera-to-world matrices in OpenGL axes, and intrinsics per file or frame.

    Returns the views and, if a file contains `ply_file_path`, its points.
    """
    views: list[KnownView] = []
    points = None
    for file in known.files:
        content = read_json_object(file, AGAIN)
        frames = content.get("frames")
        if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise SceneError(f"{file}: `frames` is missing, or is not a list of objects", fix=AGAIN)
        for number, frame in enumerate(frames):
            views.append(_read_frame(known, file, number, {**content, **frame}))
        if points is None and isinstance(content.get("ply_file_path"), str):
            _check_inside(file.parent, content["ply_file_path"])
            points = _read_ply_points(file.parent / content["ply_file_path"])
    return checked(views, known), points


def _read_frame(known: KnownPoses, file: Path, number: int, frame: Mapping[str, Any]) -> KnownView:
    """Read one frame of a transforms file; the frame's keys override those of the file."""
    where = f"{file}, frame {number}"
    try:
        name = str(frame["file_path"]).removeprefix("./")
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
    except (KeyError, ValueError, TypeError) as error:
        raise SceneError(
            f"{where}: file_path or transform_matrix is not valid: {error!r}", fix=AGAIN
        ) from error
    source_from_cam = rigid_pose(matrix, f"{where} ({name}), transform_matrix") @ OPENGL_TO_OPENCV
    image = _find_image(known.root, name)
    camera = _frame_camera(where, frame, image)
    return KnownView(name, image, camera, np.linalg.inv(source_from_cam), file.name == "transforms_test.json")


def _frame_camera(where: str, frame: Mapping[str, Any], image: Path | None) -> pycolmap.Camera:
    """Read the lens of a frame: PINHOLE, or OPENCV if it has distortion (k1, k2, p1, p2)."""
    try:
        width, height = frame.get("w"), frame.get("h")
        if width is None or height is None:
            width = height = 2  # not used, because a view without an image is skipped
            if image is not None:
                with opened_image(image) as opened:
                    width, height = opened.size
        width, height = int(width), int(height)
        if "fl_x" in frame:
            focal_x = float(frame["fl_x"])
        else:
            focal_x = width / 2 / math.tan(float(frame["camera_angle_x"]) / 2)
        focal_y = float(frame.get("fl_y", focal_x))
        params = [focal_x, focal_y, float(frame.get("cx", width / 2)), float(frame.get("cy", height / 2))]
        distortion = [float(frame.get(key, 0.0)) for key in ("k1", "k2", "p1", "p2")]
        further = [float(frame.get(key, 0.0)) for key in ("k3", "k4")]
        name, params = ("OPENCV", params + distortion) if any(distortion) else ("PINHOLE", params)
        camera = pycolmap.Camera(model=name, width=width, height=height, params=params)
    except KeyError as error:
        expected = "fl_x (px) or camera_angle_x (radians)"
        raise SceneError(f"{where} has no focal length", expected=expected, fix=AGAIN) from error
    except (TypeError, ValueError, ArithmeticError, OSError) as error:
        raise SceneError(f"{where}: the intrinsics are not valid: {error}", fix=AGAIN) from error
    model = str(frame.get("camera_model", "OPENCV"))
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE") or any(further):
        raise SceneError(
            f"{where}: lens {model} with k3, k4 = {further} is not supported",
            expected="PINHOLE or OPENCV with k1, k2, p1, p2",
            fix="undistort the images first",
        )
    return camera


def _read_ply_points(path: Path) -> Points:
    """Read the points and colours of a PLY file (grey if it has no colours)."""
    from plyfile import PlyData, PlyParseError

    try:
        vertex = PlyData.read(path)["vertex"].data
        xyz = np.stack([vertex[axis] for axis in ("x", "y", "z")], axis=1).astype(np.float64)
    except (OSError, PlyParseError, KeyError, ValueError, MemoryError) as error:
        raise SceneError(
            f"the points in {path} cannot be read: {error}",
            fix="put the file there, or remove ply_file_path from the transforms file to triangulate points",
        ) from error
    if {"red", "green", "blue"} <= set(vertex.dtype.names):
        rgb = np.stack([vertex[colour] for colour in ("red", "green", "blue")], axis=1).astype(np.uint8)
    else:
        rgb = np.full(xyz.shape, 128, dtype=np.uint8)
    return xyz, rgb


def read_llff(known: KnownPoses) -> list[KnownView]:
    """Read the posed views of an LLFF scene; row i of `poses_bounds.npy` belongs to the i-th image by name.

    The first 15 of a row's 17 numbers are a 3 x 5 matrix, by rows: rotation columns (down, right, back),
    translation, and the column (height, width, focal). OpenCV's axes are x = right, y = down, z = -back. The
    last two are the near and far depths. The lens is SIMPLE_PINHOLE with its centre in the middle, for the
    image size on disk.
    """
    path, folder = known.files[0], known.root / "images"
    try:
        rows = read_npy(path)
    except ArtifactError as error:
        raise SceneError(str(error).splitlines()[0], fix="unpack it again") from error
    if rows.ndim != 2 or rows.shape[1] != 17 or not np.isfinite(rows).all():
        raise SceneError(
            f"{path} does not contain LLFF poses",
            expected="finite numbers of shape (images, 17)",
            found=f"shape {rows.shape}",
            fix="unpack it again",
        )
    images = sorted(list_images(folder if folder.is_dir() else known.root), key=lambda image: image.stem)
    if len(images) != len(rows):
        raise SceneError(
            f"{path} has {len(rows)} poses for {len(images)} images",
            expected="one row per image, in order of file name",
            found=f"{images[0].name} to {images[-1].name}" if images else "no images",
            fix="unpack the images again, and remove files that are not photographs of the scene",
        )
    views = []
    for number, (image, row) in enumerate(zip(images, rows.astype(np.float64), strict=True)):
        down, right, back, position, (_, width_px, focal_px) = row[:15].reshape(3, 5).T
        matrix = np.stack([right, down, -back, position], axis=1)
        source_from_cam = rigid_pose(matrix, f"{path}, row {number}")
        with opened_image(image) as opened:
            width, height = opened.size
        params = [float(focal_px * width / width_px), width / 2, height / 2]
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)
        views.append(KnownView(image.name, image, camera, np.linalg.inv(source_from_cam)))
    return views


def read_polycam(known: KnownPoses) -> list[KnownView]:
    """Read the posed views of a raw Polycam export.

    `keyframes/cameras/<stem>.json`, or its corrected version, contains fx, fy, cx, cy, width, height in px,
    and t_00 ... t_23, the rows of the camera-to-world matrix, in metres and OpenGL axes.
    """
    images, cameras = known.files
    border_px = POLYCAM_BORDER_PX if images.name.startswith("corrected") else 0
    views = []
    for image in _spread(list_images(images)):
        file = cameras / f"{image.stem}.json"
        if not file.is_file():
            continue  # Polycam omits cameras that it could not correct
        content = read_json_object(file, AGAIN)
        try:
            entries = [float(content[f"t_{row}{column}"]) for row in range(3) for column in range(4)]
            size = {side: int(content[side]) for side in ("width", "height")}
            params = [float(content[key]) for key in ("fx", "fy", "cx", "cy")]
            camera = pycolmap.Camera(model="PINHOLE", params=params, **size)
        except (KeyError, TypeError, ValueError) as error:
            raise SceneError(
                f"{file} is not a Polycam camera file: {error!r}",
                expected="fx, fy, cx, cy, width, height and t_00 to t_23",
                fix="export the raw data again (developer mode)",
            ) from error
        pose = _phone_pose(np.array(entries).reshape(3, 4), str(file))
        views.append(KnownView(image.name, image, camera, pose, border_px=border_px))
    return views


def read_record3d(known: KnownPoses) -> list[KnownView]:
    """Read the posed views of a Record3D export.

    `metadata` contains `K` in column order, `w` and `h` in px, and `poses`. Row i of `poses` is the camera's
    quaternion (xyzw) and position in the world for image <i>.jpg, in metres and OpenGL axes.
    """
    from scipy.spatial.transform import Rotation

    folder, file = known.files
    content = read_json_object(file, AGAIN)
    try:
        intrinsics = np.array(content["K"], dtype=np.float64).reshape(3, 3).T
        width, height = int(content["w"]), int(content["h"])
        rows = np.array(content["poses"], dtype=np.float64).reshape(-1, 7)
        matrices = np.concatenate([Rotation.from_quat(rows[:, :4]).as_matrix(), rows[:, 4:, None]], axis=2)
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(
            f"{file} does not contain Record3D poses: {error!r}",
            expected="K (9 numbers), w, h, and poses (rows of 7 numbers)",
            fix="export the recording again",
        ) from error
    images = {int(path.stem): path for path in list_images(folder) if path.stem.isdigit()}
    params = [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]
    views = []
    for number in _spread(sorted(number for number in images if number < len(matrices))):
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
        pose = _phone_pose(matrices[number], f"{file}, pose {number}")
        views.append(KnownView(images[number].name, images[number], camera, pose))
    return views


def _spread(items: list[Any]) -> list[Any]:
    """Sample at most `MAX_VIEWS` items evenly, including the first and the last."""
    if len(items) <= MAX_VIEWS:
        return items
    return [items[row] for row in np.linspace(0, len(items) - 1, MAX_VIEWS).round().astype(int)]


def _phone_pose(world_from_cam: Float64[np.ndarray, "3 4"], where: str) -> Float64[np.ndarray, "4 4"]:
    """Convert a camera-to-world matrix (OpenGL axes, y up) to world-to-camera (OpenCV axes, z up)."""
    return np.linalg.inv(Z_UP_FROM_Y_UP @ rigid_pose(world_from_cam, where) @ OPENGL_TO_OPENCV)
