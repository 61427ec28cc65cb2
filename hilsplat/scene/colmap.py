"""pycolmap, loaded after Pillow (import it only from here), and conversions of its models to arrays.

Measured with pycolmap 4.2.1 and Pillow 13.0: if pycolmap is loaded before Pillow's core, writing a PNG with
Pillow corrupts the heap, and the process aborts or hangs. The reverse order works. pycolmap's handler of
SIGTERM, which reports a crash if a job is cancelled, is replaced by the former one.
"""

import ctypes
import signal
import sys
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image  # noqa: F401

from hilsplat.scene.cameras import Photo

_libc = ctypes.CDLL(None) if sys.platform != "win32" else None
_on_sigterm = ctypes.create_string_buffer(512)  # `struct sigaction` has 152 bytes on Linux, fewer on macOS
if _libc:  # Python's own `signal.signal` works only in the main thread
    _libc.sigaction(signal.SIGTERM, None, _on_sigterm)

# isort: split
import pycolmap as pycolmap  # noqa: E402

if _libc:
    _libc.sigaction(signal.SIGTERM, _on_sigterm, None)

Points = tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]  # positions and colours


def pose_matrix(pose: pycolmap.Rigid3d) -> Float64[np.ndarray, "4 4"]:
    """Return a pose of COLMAP's mappers as a 4 x 4 matrix."""
    return np.vstack([pose.matrix(), [0.0, 0.0, 0.0, 1.0]])


LENGTH_TOLERANCE = 0.01  # maximum deviation of a quaternion's length from 1; programs write at least 3 digits


def rotation_matrix(quat_xyzw: Sequence[float]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a unit quaternion from another program; NaN if its length is not 1."""
    quat = np.array(quat_xyzw, np.float64)
    length = np.linalg.norm(quat)
    is_unit = abs(length - 1) <= LENGTH_TOLERANCE  # false for NaN
    return pycolmap.Rotation3d(quat / length).matrix() if is_unit else np.full((3, 3), np.nan)


PERSPECTIVE = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "FOV", "SIMPLE_DIVISION", "DIVISION")
"""Lens models that are pinhole cameras if all their distortion coefficients are zero; fisheyes aren't."""


def is_pinhole(camera: pycolmap.Camera) -> bool:
    """Return whether a lens has no distortion. `camera.is_undistorted()` is true for some fisheye lenses."""
    if camera.model_name in ("PINHOLE", "SIMPLE_PINHOLE"):
        return True
    return camera.model_name in PERSPECTIVE and not any(camera.params[i] for i in camera.extra_params_idxs())


def as_camera(photo: Photo) -> pycolmap.Camera:
    """Return a photograph's camera. Parameters beyond those of its model are ignored."""
    camera = pycolmap.Camera.create_from_model_name(1, photo.model, 1.0, *photo.size_hw[::-1])
    camera.params = photo.params[: len(camera.params)]
    return camera


def camera_of(image: pycolmap.Image) -> pycolmap.Camera:
    """Return a copy of the camera of an image in a model: the original becomes invalid with the model."""
    assert image.camera is not None  # only images outside a model have no camera
    return pycolmap.Camera(image.camera.todict())


def sparse_points(model: pycolmap.Reconstruction) -> Points:
    """Return the sparse points and colours of a model, sorted by point id."""
    points = [model.points3D[point_id] for point_id in sorted(model.points3D)]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    rgb = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
    return xyz, rgb


def reprojection_errors(model: pycolmap.Reconstruction) -> dict[str, Float64[np.ndarray, " n"]]:
    """Compute the distance in px between each observation and its point's projection, per registered view."""
    errors = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        seen = image.get_observation_points2D()
        measured = np.array([point.xy for point in seen]).reshape(-1, 2)
        xyz = np.array([model.points3D[point.point3D_id].xyz for point in seen]).reshape(-1, 3)
        pose = image.cam_from_world().matrix()
        projected = camera_of(image).img_from_cam(xyz @ pose[:, :3].T + pose[:, 3], check_cheirality=False)
        errors[image.name] = np.linalg.norm(projected - measured, axis=1)
    return errors
