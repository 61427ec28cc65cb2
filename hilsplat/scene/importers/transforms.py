"""Reader of transforms.json, as nerfstudio, instant-ngp and Blender write it.

The meaning of keys follows nerfstudio's `nerfstudio_dataparser.py` and instant-ngp's `nerf_loader.cu`.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.errors import SceneError, foreign
from hilsplat.base.images import image_size_hw
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.importers.known_views import KnownView, Source, find_images, require_inside
from hilsplat.scene.importers.ply_file import read_ply_points
from hilsplat.scene.layouts import KnownPoses, read_json_object
from hilsplat.scene.posed_images import OPENGL_TO_OPENCV, rigid_pose

FOCAL = {axis: (f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov") for axis in "xy"}
FOCAL_KEYS = frozenset((*FOCAL["x"], *FOCAL["y"]))
"""Keys of a focal length: px, field of view in radians, and in degrees."""

FOCAL_TOLERANCE = 0.01
"""Relative difference between several statements of one focal length, above which they contradict."""

PERSPECTIVES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
FISHEYES = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
MODELS = dict.fromkeys(PERSPECTIVES, "OPENCV") | dict.fromkeys(FISHEYES, "OPENCV_FISHEYE")
"""COLMAP's lens model with the distortion coefficients of a `camera_model`."""

COEFFICIENTS = {"OPENCV": ("k1", "k2", "p1", "p2", "k3"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}

SPLITS = ("train_filenames", "val_filenames", "test_filenames")

# applied_transform and applied_scale are used for Gaussians, see `splat/coordinates.py`.
USED = """frames file_path transform_matrix w h width height cx cy k1 k2 k3 k4 p1 p2 camera_model is_fisheye
ply_file_path applied_transform applied_scale test_frames"""
HARMLESS = """aabb_scale scale offset n_frames up sharpness rotation render_aabb orientation_override
colmap_im_id depth_file_path depth_path depth_unit_scale_factor integer_depth_scale enable_depth_loading
normal_file_path sharpen white_transparent black_transparent timestamp auto_scale_poses_override center_method
version"""
UNSUPPORTED = {
    "ortho is_ortho orthographic": "orthographic pictures",
    "latlong equirectangular": "panoramas",
    "rolling_shutter transform_matrix_start transform_matrix_end": "a rolling shutter",
    "shift_x shift_y skew": "a shifted or skewed lens",
    "ftheta_p0 ftheta_p1 ftheta_p2 ftheta_p3 ftheta_p4 lens_mode": "a special lens",
    "from_na from_mitsuba normal_mts_args": "camera axes other than OpenGL's",  # NeuS2, Mitsuba
    "k5 k6 p3 p4 s1 s2 s3 s4 b1 b2 distortion distortion_params": "more lens distortion",
}
KNOWN = {*USED.split(), *FOCAL_KEYS, *SPLITS, *HARMLESS.split()}
REFUSED = {key: meaning for keys, meaning in UNSUPPORTED.items() for key in keys.split()}


def read_transforms(known: KnownPoses) -> Source:
    """Read transforms files: camera-to-world matrices in OpenGL axes, and intrinsics per file or frame.

    A frame's keys override those of its file. Without a size, it is the image's. Lists of file names are the
    source's split: a view is held out unless it is in `train_filenames`, or else if it is in one of the
    other lists. The `test_frames` of ScanNet++ are held out. Points are read if `ply_file_path` names them.
    """
    source, contents = Source(), []
    for file in known.files:
        content = read_json_object(file, "export it again")
        frames: list[dict[str, Any]] = []
        for key, rows in (
            ("frames", content.get("frames")),
            ("test_frames", content.get("test_frames") or []),
        ):
            if not isinstance(rows, list) or not all(isinstance(frame, dict) for frame in rows):
                problem = f"{file}: `{key}` is missing, or is not a list of objects"
                raise SceneError(problem, fix="export it again")
            frames += rows
        source.check_keys([content, *frames], file, KNOWN, REFUSED)
        names = [str(frame.get("file_path", f"frame {number}")) for number, frame in enumerate(frames)]
        contents.append((file, content, frames, names))
    images = find_images(known.root, [name for *_, names in contents for name in names])
    for file, content, frames, names in contents:
        held_out = _held_out(content, names, source)
        source.has_split |= bool(content.get(SPLITS[0]))
        num_train = len(content["frames"]) if file == known.files[0] else 0
        for number, (name, frame) in enumerate(zip(names, frames, strict=True)):
            replaced = FOCAL_KEYS if FOCAL_KEYS & frame.keys() else frozenset()
            merged = {key: value for key, value in content.items() if key not in replaced} | frame
            where, is_test = f"{file}, frame {number} ({name})", number >= num_train or name in held_out
            source.add(name, _view, where, merged, name, images[name], is_test, source.notes)
        if source.points is None and content.get("ply_file_path") is not None:
            ply = str(content["ply_file_path"]).replace("\\", "/")
            require_inside(file.parent, ply)
            source.points = read_ply_points(file.parent / ply)
    source.notes = list(dict.fromkeys(source.notes))
    return source


def _held_out(content: Mapping[str, Any], names: list[str], source: Source) -> set[str]:
    """Return the frames that the file's lists of names keep from training."""
    listed: list[set[str]] = []
    for key in SPLITS:
        value = content.get(key)
        if value is not None and not isinstance(value, list):
            source.notes.append(f"{key} is not a list of names, and is not used")
        listed.append(source.listed(map(str, value if isinstance(value, list) else []), names, key))
    train, *others = listed
    return set(names) - train if train else set().union(*others)


def _view(
    where: str, frame: Mapping[str, Any], name: str, image: Path | None, is_test: bool, notes: list[str]
) -> KnownView:
    with foreign(where, expected="file_path, and transform_matrix as a 4 x 4 matrix"):
        if not isinstance(frame["file_path"], str):
            raise ValueError("file_path is not a text")
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
    pose = rigid_pose(matrix, f"{where}, transform_matrix") @ OPENGL_TO_OPENCV
    return KnownView(name, image, _lens(where, frame, image, notes), np.linalg.inv(pose), is_test)


def _lens(where: str, frame: Mapping[str, Any], image: Path | None, notes: list[str]) -> pycolmap.Camera:
    """Return the lens of a frame: PINHOLE, or with distortion OPENCV, FULL_OPENCV or OPENCV_FISHEYE."""
    with foreign(where, expected="finite numbers", fix="export it again"):
        values = {key: value for key, value in frame.items() if value is not None}
        stated = str(values.get("camera_model", "OPENCV")).upper()
        if (fisheye := values.get("is_fisheye", False)) not in (True, False):
            raise ValueError(f"is_fisheye is {fisheye!r}, not true or false")
        model = "OPENCV_FISHEYE" if fisheye else MODELS.get(stated, "")
        bends = {key: float(values.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
        extra = {key: bend for key, bend in bends.items() if bend and key not in COEFFICIENTS.get(model, ())}
        if not model or extra:
            raise SceneError(
                f"{where}: lens {stated}{f' with {extra}' if extra else ''} is not supported",
                expected="; ".join(f"{lens} with {' '.join(keys)}" for lens, keys in COEFFICIENTS.items()),
                fix="undistort the images first",
            )
        width, height = values.get("w", values.get("width")), values.get("h", values.get("height"))
        if width is None or height is None:
            height, width = image_size_hw(image) if image is not None else (2, 2)  # not used without an image
        width, height = int(width), int(height)
        focal = {
            axis: _focal(frame, axis, side, notes)
            for axis, side in (("x", width), ("y", height))
            if values.keys() & FOCAL[axis]
        }
        focal_x, focal_y = focal.get("x", focal.get("y")), focal.get("y", focal.get("x"))
        if not focal_x or not focal_y:
            expected = "fl_x (px), camera_angle_x (radians) or x_fov (degrees), or the same for y"
            raise SceneError(f"{where} has no focal length", expected=expected, fix="export it again")
        params = [focal_x, focal_y, float(values.get("cx", width / 2)), float(values.get("cy", height / 2))]
        coefficients = [bends[key] for key in COEFFICIENTS[model]]
        if model == "OPENCV" and bends["k3"]:
            model, coefficients = "FULL_OPENCV", [*coefficients, 0.0, 0.0, 0.0]
        elif model == "OPENCV":
            model, coefficients = (model, coefficients[:4]) if any(coefficients) else ("PINHOLE", [])
        return pycolmap.Camera(model=model, width=width, height=height, params=params + coefficients)


def _focal(frame: Mapping[str, Any], axis: str, side_px: int, notes: list[str]) -> float:
    """Return the focal length along an axis, px. The first of several counts."""
    stated = {}
    for key in FOCAL[axis]:
        if frame.get(key) is not None:
            value = float(frame[key])
            angle = math.radians(value) if key.endswith("fov") else value
            if not key.startswith("fl_") and not 0 < angle < math.pi:
                unit = "degrees" if key.endswith("fov") else "radians"
                raise ValueError(f"{key} is {value:g}, not an angle in {unit}")
            stated[key] = value if key.startswith("fl_") else side_px / 2 / math.tan(angle / 2)
    first, *others = stated
    for key in others:
        if abs(stated[key] - stated[first]) > FOCAL_TOLERANCE * abs(stated[first]):
            notes.append(f"{key} contradicts {first}, which is used")
    return stated[first]
