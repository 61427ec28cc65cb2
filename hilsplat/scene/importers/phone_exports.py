"""Poses measured by phones while recording: raw exports of Polycam and Record3D.

Layouts and axes are those of nerfstudio's `polycam_utils.py`, `record3d_utils.py` and `process_data.py`.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.artifacts import parse_json
from hilsplat.base.errors import SceneError
from hilsplat.base.files import list_images
from hilsplat.base.rotations import RIGID_TOLERANCE, are_rotations
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.importers.known_poses import KnownPoses, KnownView

MAX_VIEWS = 300
"""Maximum number of views, sampled evenly, because a recording has many more frames than a scene needs
(nerfstudio: 300 for Record3D, 600 for Polycam)."""

POLYCAM_BORDER_PX = 15
"""Width of the black borders of corrected images, from undistortion (nerfstudio: `crop_border_pixels`)."""

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
Z_UP_FROM_Y_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""ARKit's world has y up; scenes here have z up. This is a cyclic permutation, so nothing is mirrored."""


def read_polycam(known: KnownPoses) -> list[KnownView]:
    """Read the posed views of a raw Polycam export.

    `keyframes/cameras/<stem>.json` or its corrected version contains fx, fy, cx, cy, width, height in px, and
    t_00 ... t_23, the camera-to-world matrix by rows, metres, OpenGL axes.
    """
    images, cameras = known.files
    border_px = POLYCAM_BORDER_PX if images.name.startswith("corrected") else 0
    views = []
    for image in _spread(list_images(images)):
        file = cameras / f"{image.stem}.json"
        if not file.is_file():
            continue  # Polycam omits cameras that it could not correct
        content = _json(file)
        try:
            matrix = np.array(
                [[float(content[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
            )
            camera = pycolmap.Camera(
                model="PINHOLE",
                width=int(content["width"]),
                height=int(content["height"]),
                params=[float(content[key]) for key in ("fx", "fy", "cx", "cy")],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise SceneError(
                f"{file} is not a camera of Polycam: {error!r}",
                expected="fx, fy, cx, cy, width, height and t_00 to t_23",
                fix="export the raw data again (developer mode)",
            ) from error
        views.append(KnownView(image.name, image, camera, _pose(matrix, str(file)), border_px=border_px))
    return views


def read_record3d(known: KnownPoses) -> list[KnownView]:
    """Read the posed views of a Record3D export.

    `metadata` contains `K` by columns, `w` and `h` in px, and `poses`, one row per image <number>.jpg:
    quaternion xyzw and position of the camera in the world, metres, OpenGL axes.
    """
    from scipy.spatial.transform import Rotation

    folder, file = known.files
    content = _json(file)
    try:
        intrinsics = np.array(content["K"], dtype=np.float64).reshape(3, 3).T
        width, height = int(content["w"]), int(content["h"])
        rows = np.array(content["poses"], dtype=np.float64).reshape(-1, 7)
        matrices = np.concatenate([Rotation.from_quat(rows[:, :4]).as_matrix(), rows[:, 4:, None]], axis=2)
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(
            f"{file} does not hold poses of Record3D: {error!r}",
            expected="K (9 numbers), w, h, and poses (rows of 7 numbers)",
            fix="export the recording again",
        ) from error
    images = {int(path.stem): path for path in list_images(folder) if path.stem.isdigit()}
    params = [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]
    views = []
    for number in _spread(sorted(number for number in images if number < len(matrices))):
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
        pose = _pose(matrices[number], f"{file}, pose {number}")
        views.append(KnownView(images[number].name, images[number], camera, pose))
    return views


def _spread(items: list[Any]) -> list[Any]:
    """Sample at most `MAX_VIEWS` items evenly, including the first and the last."""
    if len(items) <= MAX_VIEWS:
        return items
    return [items[row] for row in np.linspace(0, len(items) - 1, MAX_VIEWS).round().astype(int)]


def _json(file: Path) -> dict[str, Any]:
    try:
        content = parse_json(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SceneError(f"{file} is not valid JSON: {error}", fix="export it again") from error
    if not isinstance(content, dict):
        raise SceneError(f"{file} does not hold a JSON object", fix="export it again")
    return content


def _pose(world_from_cam: Float64[np.ndarray, "3 4"], where: str) -> Float64[np.ndarray, "4 4"]:
    """Convert a camera-to-world matrix (OpenGL axes, y up) to world-to-camera (OpenCV axes, z up)."""
    if not np.isfinite(world_from_cam).all() or not are_rotations(world_from_cam[:, :3], RIGID_TOLERANCE):
        raise SceneError(
            f"{where}: not a rigid pose",
            found=np.array2string(world_from_cam, precision=4, suppress_small=True).replace("\n", ""),
            fix="export it again",
        )
    full = np.vstack([world_from_cam, [0.0, 0.0, 0.0, 1.0]])
    return np.linalg.inv(Z_UP_FROM_Y_UP @ full @ OPENGL_TO_OPENCV)
