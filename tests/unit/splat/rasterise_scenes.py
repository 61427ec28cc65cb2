"""Cameras and small scenes for the tests of the rasteriser."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians
from tests.unit.round_gaussians import round_gaussians


def camera(height: int = 40, width: int = 56, focal: float = 50.0) -> Camera:
    """A rotated and shifted camera, so that every entry of the pose matters."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("yx", (0.3, -0.2)).as_matrix()
    pose[:3, 3] = (0.1, -0.2, 0.3)
    K = np.array([[focal, 0, width / 2 + 1.5], [0, focal * 1.1, height / 2 - 2.0], [0, 0, 1]])
    return Camera("view.png", pose, K, (height, width))


def straight_camera() -> Camera:
    """At the origin, along z; 30 px of focal length, principal point (16, 12), 24 x 32 px."""
    return Camera("v.png", np.eye(4), np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), (24, 32))


def random_gaussians(n: int, seed: int = 0, degree: int = 3) -> Gaussians:
    """Gaussians around the frustum of `camera()`: in front, aside and a few behind the camera."""
    rng = np.random.default_rng(seed)
    cam = np.stack([rng.uniform(-2, 2, n), rng.uniform(-1.6, 1.6, n), rng.uniform(-0.3, 4, n)], axis=1)
    pose = camera().cam_from_world
    arrays = (
        (cam - pose[:3, 3]) @ pose[:3, :3],
        np.log(rng.uniform(0.02, 0.25, (n, 3))),
        rng.normal(size=(n, 4)),
        rng.normal(size=n) * 2,
        rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.4,
    )
    return Gaussians(*(values.astype(np.float32) for values in arrays))


def round_gaussian(opacity: float, scale: float, depth: float) -> Gaussians:
    """One round white Gaussian on the optical axis of a camera at the origin."""
    logit = math.log(opacity / (1 - opacity))
    plain = round_gaussians(np.array([[0, 0, depth]]), log_scale=math.log(scale), opacity_logit=logit)
    plain.sh[:] = 0.5 / 0.28209479177387814
    return plain


def rows(gaussians: Gaussians, chosen: slice | np.ndarray) -> Gaussians:
    """Some of the Gaussians."""
    return Gaussians(*(getattr(gaussians, name)[chosen] for name in FIELDS))
