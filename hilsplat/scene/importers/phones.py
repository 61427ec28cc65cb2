"""Readers of Polycam and Record3D exports.

Layouts and axes match those in nerfstudio's `polycam_utils.py` and `record3d_utils.py`.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.errors import SceneError, foreign
from hilsplat.base.files import list_images
from hilsplat.base.images import image_size_hw
from hilsplat.scene.colmap import pycolmap, rotation_matrix
from hilsplat.scene.importers.known_views import KnownView, Source
from hilsplat.scene.layouts import KnownPoses, read_json_object
from hilsplat.scene.posed_images import OPENGL_TO_OPENCV, rigid_pose

AGAIN = "export the recording again (Polycam: raw data, in developer mode)"

MAX_VIEWS = 300
"""Maximum number of views used from a phone export, sampled evenly: a recording has many more frames than a
scene needs (nerfstudio: 300 for Record3D, 600 for Polycam)."""

POLYCAM_BORDER_PX = 15
"""Width of black borders left by undistortion in corrected images (nerfstudio: `crop_border_pixels`)."""

Z_UP_FROM_Y_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""ARKit's world has y up; scenes here have z up. This is a cyclic permutation, so nothing is mirrored."""

POLYCAM_USED = "fx fy cx cy width height t_00 t_01 t_02 t_03 t_10 t_11 t_12 t_13 t_20 t_21 t_22 t_23"
POLYCAM_HARMLESS = """angular_velocity blur_score center_depth exposure_duration iso manual_keyframe neighbors
neighbors_2 timestamp version lens white_balance"""
POLYCAM_KEYS = {*POLYCAM_USED.split(), *POLYCAM_HARMLESS.split()}
RECORD3D_HARMLESS = """fps dw dh initPose cameraType frameTimestamps confidenceWidth confidenceHeight
userComment rangeOfInterest hardwareModel"""
RECORD3D_KEYS = {"K", "w", "h", "poses", "perFrameIntrinsicCoeffs", *RECORD3D_HARMLESS.split()}
REFUSED_KEYS = ("k1", "k2", "k3", "p1", "p2", "distortion", "lensDistortionLookupTable")
REFUSED = dict.fromkeys(REFUSED_KEYS, "lens distortion")


def read_polycam(known: KnownPoses) -> Source:
    """Read the posed views of a raw Polycam export.

    `keyframes/cameras/<stem>.json`, or its corrected version, contains fx, fy, cx, cy, width, height in px,
    and t_00 ... t_23, the rows of the camera-to-world matrix, in metres and OpenGL axes. Without a size, it
    is the image's.
    """
    images, cameras = known.files
    border_px = POLYCAM_BORDER_PX if images.name.startswith("corrected") else 0
    source, contents = Source(), []

    def described(image: Path, file: Path) -> KnownView:
        content = read_json_object(file, AGAIN)
        contents.append(content)
        with foreign(file, expected="fx, fy, cx, cy, width, height and t_00 to t_23", fix=AGAIN):
            entries = [float(content[f"t_{row}{column}"]) for row in range(3) for column in range(4)]
            params = [float(content[key]) for key in ("fx", "fy", "cx", "cy")]
            width, height = content.get("width"), content.get("height")
            if width is None or height is None:
                height, width = image_size_hw(image)
            camera = pycolmap.Camera(model="PINHOLE", params=params, width=int(width), height=int(height))
        pose = _phone_pose(np.array(entries).reshape(3, 4), str(file))
        return KnownView(image.name, image, camera, pose, border_px=border_px)

    for image in _spread(list_images(images), source):
        file = cameras / f"{image.stem}.json"
        if file.is_file():  # Polycam omits cameras that it could not correct
            source.add(image.name, described, image, file)
    source.check_keys(contents, cameras, POLYCAM_KEYS, REFUSED)
    return source


def read_record3d(known: KnownPoses) -> Source:
    """Read the posed views of a Record3D export.

    `metadata` contains `K` in column order, `w` and `h` in px, and `poses`. Row i of `poses` is the camera's
    quaternion (xyzw) and position in the world for image <i>.jpg, in metres and OpenGL axes. Row i of
    `perFrameIntrinsicCoeffs`, if present, is the lens of that image (fx, fy, cx, cy), which then replaces K.
    """
    folder, file = known.files
    content = read_json_object(file, AGAIN)
    expected = "K (9 numbers), w, h, and poses (rows of 7 numbers)"
    with foreign(file, expected=expected, fix=AGAIN):
        K = np.array(content["K"], dtype=np.float64).reshape(3, 3).T
        if K[2].tolist() != [0, 0, 1]:
            raise ValueError("K is not in column order")
        width, height = int(content["w"]), int(content["h"])
        rows = np.array(content["poses"], dtype=np.float64).reshape(-1, 7)
        lenses = np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], (len(rows), 1))
        if (coefficients := content.get("perFrameIntrinsicCoeffs")) is not None:
            lenses = np.array(coefficients, dtype=np.float64)
            if lenses.shape != (len(rows), 4):
                raise ValueError(f"perFrameIntrinsicCoeffs has shape {lenses.shape}, but {len(rows)} poses")
    images = {int(path.stem): path for path in list_images(folder) if path.stem.isdecimal()}

    def described(number: int) -> KnownView:
        if number >= len(rows):
            raise SceneError(f"{file} has only {len(rows)} poses, the first one for image 0")
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=lenses[number])
        matrix = np.column_stack([rotation_matrix(rows[number, :4].tolist()), rows[number, 4:]])
        pose = _phone_pose(matrix, f"{file}, pose {number}")
        return KnownView(images[number].name, images[number], camera, pose)

    source = Source()
    source.check_keys([content], file, RECORD3D_KEYS, REFUSED)
    for number in _spread(sorted(images), source):
        source.add(images[number].name, described, number)
    return source


def _spread(items: list[Any], source: Source) -> list[Any]:
    """Sample at most `MAX_VIEWS` items evenly, including the first and the last."""
    if len(items) <= MAX_VIEWS:
        return items
    source.notes.append(f"{MAX_VIEWS} of {len(items)} views are used, evenly spread")
    return [items[row] for row in np.linspace(0, len(items) - 1, MAX_VIEWS).round().astype(int)]


def _phone_pose(world_from_cam: Float64[np.ndarray, "3 4"], where: str) -> Float64[np.ndarray, "4 4"]:
    """Convert a camera-to-world matrix (OpenGL axes, y up) to world-to-camera (OpenCV axes, z up)."""
    return np.linalg.inv(Z_UP_FROM_Y_UP @ rigid_pose(world_from_cam, where) @ OPENGL_TO_OPENCV)
