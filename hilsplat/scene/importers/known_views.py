"""Readers of posed views: COLMAP, transforms.json (nerfstudio, Blender), LLFF, Polycam, Record3D."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.artifacts import parse_json
from hilsplat.base.errors import SceneError
from hilsplat.base.files import IMAGE_SUFFIXES
from hilsplat.base.images import open_image
from hilsplat.base.rotations import RIGID_TOLERANCE, are_rotations
from hilsplat.scene.cameras import MAX_SIDE_PX
from hilsplat.scene.colmap import camera_of, pose_matrix, pycolmap, reprojection_errors, sparse_points
from hilsplat.scene.importers.known_poses import KnownPoses, KnownView, checked
from hilsplat.scene.importers.llff import read_llff
from hilsplat.scene.importers.model_files import require_whole_files
from hilsplat.scene.importers.phone_exports import OPENGL_TO_OPENCV, read_polycam, read_record3d

Points = tuple[np.ndarray, np.ndarray]
"""Positions and colours."""

Errors = dict[str, dict[str, Any]]
"""Number of observations and mean reprojection error of each view."""


def read_source(known: KnownPoses) -> tuple[list[KnownView], Points | None, Errors]:
    """Read the posed views of a folder in any supported format, with points and errors if it has them."""
    if known.kind == "colmap":
        return read_colmap(known)
    if known.kind == "transforms":
        return *read_transforms(known), {}
    readers = {"polycam": read_polycam, "record3d": read_record3d, "llff": read_llff}
    return checked(readers[known.kind](known), known), None, {}


def read_colmap(known: KnownPoses) -> tuple[list[KnownView], Points, Errors]:
    """Read a COLMAP model."""
    folder = known.files[0]
    require_whole_files(folder)
    try:
        model = pycolmap.Reconstruction(folder)
        views = []
        images = (model.images[image_id] for image_id in model.reg_image_ids())
        for image in sorted(images, key=lambda image: image.name):
            file, camera = _find_image(known.root, image.name), pycolmap.Camera(camera_of(image).todict())
            views.append(KnownView(image.name, file, camera, pose_matrix(image.cam_from_world())))
        errors = {
            name: {
                "observations": len(of_view),
                "reprojection_error_px": round(float(of_view.mean()), 4) if len(of_view) else None,
            }
            for name, of_view in reprojection_errors(model).items()
        }
        points = sparse_points(model)
    except (ValueError, RuntimeError, IndexError) as error:  # also for references to missing entries
        raise SceneError(
            f"the COLMAP model in {folder} cannot be read: {error}", fix="export it again with COLMAP"
        ) from error
    return checked(views, known), points, errors


def _find_image(root: Path, name: str) -> Path | None:
    """Find an image named in a source, with or without a suffix, in the folder or its images/."""
    _check_inside(root, name)
    for base in (root / "images", root):
        candidate = base / name
        if candidate.is_file():
            return candidate
        for suffix in sorted(IMAGE_SUFFIXES):
            if (with_suffix := candidate.with_name(candidate.name + suffix)).is_file():
                return with_suffix
    return None


def _check_inside(root: Path, name: str) -> None:
    """Refuse a name that leads out of the source's folder: downloaded data could otherwise read any file."""
    if Path(name).is_absolute() or Path(os.path.normpath(name)).parts[:1] == ("..",):
        raise SceneError(
            f"the poses in {root} name a file outside it: {name}",
            expected="names below the folder",
            fix="put the images into the folder, and correct the names in the file with the poses",
        )


def read_transforms(known: KnownPoses) -> tuple[list[KnownView], Points | None]:
    """Read transforms files: camera-to-world in OpenGL axes, with common intrinsics or intrinsics per frame.

    Returns the views and, if a file contains `ply_file_path`, its points.
    """
    views: list[KnownView] = []
    points = None
    for file in known.files:
        try:
            content = parse_json(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise SceneError(f"{file} is not valid JSON: {error}", fix="export it again") from error
        if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
            raise SceneError(f"{file} has no list `frames`", fix="export it again")
        for number, frame in enumerate(content["frames"]):
            if not isinstance(frame, dict):
                raise SceneError(f"{file}, frame {number} is not an object", fix="export it again")
            views.append(_read_frame(known, file, number, {**content, **frame}))
        if points is None and isinstance(content.get("ply_file_path"), str):
            _check_inside(file.parent, content["ply_file_path"])
            points = _read_ply_points(file.parent / content["ply_file_path"])
    return checked(views, known), points


def _read_frame(known: KnownPoses, file: Path, number: int, frame: Mapping[str, Any]) -> KnownView:
    """Read one frame of a transforms file; its own keys override those of the file."""
    where = f"{file}, frame {number}"
    try:
        name = str(frame["file_path"]).removeprefix("./")
        source_from_cam = np.array(frame["transform_matrix"], dtype=np.float64)
    except (KeyError, ValueError, TypeError) as error:
        raise SceneError(
            f"{where}: file_path or transform_matrix cannot be used: {error!r}", fix="export it again"
        ) from error
    if (
        source_from_cam.shape not in ((4, 4), (3, 4))
        or not np.isfinite(source_from_cam).all()
        or not are_rotations(source_from_cam[:3, :3], RIGID_TOLERANCE)
    ):
        raise SceneError(
            f"{where} ({name}): transform_matrix is not a rigid pose",
            expected="a 4 x 4 camera-to-world matrix whose rotation part neither scales nor mirrors",
            found=np.array2string(source_from_cam, precision=4, suppress_small=True).replace("\n", ""),
            fix="export it again without scaling the cameras",
        )
    pose = np.eye(4)
    pose[:3] = source_from_cam[:3]
    image = _find_image(known.root, name)
    camera = _frame_camera(where, frame, image)
    is_test = file.name == "transforms_test.json"
    return KnownView(name, image, camera, np.linalg.inv(pose @ OPENGL_TO_OPENCV), is_test)


def _frame_camera(where: str, frame: Mapping[str, Any], image: Path | None) -> pycolmap.Camera:
    """Read the lens of a frame: PINHOLE, or OPENCV if it has distortion (k1, k2, p1, p2)."""
    try:
        width, height = frame.get("w"), frame.get("h")
        if width is None or height is None:
            if image is None:
                width = height = 2  # not used: a view without an image is skipped
            else:
                with open_image(image) as opened:
                    width, height = opened.size
        width, height = int(width), int(height)
        if "fl_x" in frame:
            focal_x = float(frame["fl_x"])
        else:
            focal_x = width / 2 / math.tan(float(frame["camera_angle_x"]) / 2)
        focal_y = float(frame.get("fl_y", focal_x))
        centre = [float(frame.get("cx", width / 2)), float(frame.get("cy", height / 2))]
        lens = [float(frame.get(key, 0.0)) for key in ("k1", "k2", "p1", "p2")]
        further = [float(frame.get(key, 0.0)) for key in ("k3", "k4")]
    except KeyError as error:
        raise SceneError(
            f"{where} has no focal length",
            expected="fl_x (px) or camera_angle_x (radians)",
            fix="export it again",
        ) from error
    except (TypeError, ValueError, OverflowError, OSError) as error:
        raise SceneError(f"{where}: intrinsics cannot be used: {error}", fix="export it again") from error
    model = str(frame.get("camera_model", "OPENCV"))
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE") or any(further):
        raise SceneError(
            f"{where}: lens {model} with k3, k4 = {further} is not supported",
            expected="PINHOLE or OPENCV with k1, k2, p1, p2",
            fix="undistort the images first",
        )
    if not (focal_x > 0 and focal_y > 0 and 0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise SceneError(
            f"{where}: focal length and size cannot be those of a photograph",
            expected=f"more than 0, sides of at most {MAX_SIDE_PX} px",
            found=f"{focal_x:g} and {focal_y:g}, {width:g} x {height:g} px",
            fix="export it again",
        )
    name, distortion = ("OPENCV", lens) if any(lens) else ("PINHOLE", [])
    params = [focal_x, focal_y, *centre, *distortion]
    return pycolmap.Camera(model=name, width=width, height=height, params=params)


def _read_ply_points(path: Path) -> Points:
    """Read the points and colours of a PLY file (grey if it has no colours)."""
    from plyfile import PlyData, PlyParseError

    try:
        vertex = PlyData.read(path)["vertex"].data
        xyz = np.stack([vertex[axis] for axis in ("x", "y", "z")], axis=1).astype(np.float64)
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise SceneError(
            f"the points of {path} cannot be read: {error}",
            fix="put the file there, or remove ply_file_path from the file to have points computed",
        ) from error
    if {"red", "green", "blue"} <= set(vertex.dtype.names):
        rgb = np.stack([vertex[colour] for colour in ("red", "green", "blue")], axis=1).astype(np.uint8)
    else:
        rgb = np.full(xyz.shape, 128, dtype=np.uint8)
    return xyz, rgb
