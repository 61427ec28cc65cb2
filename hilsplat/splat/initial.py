"""Inputs of a fit: the training views, scaled to the fit's resolution, and the initial Gaussians."""

import logging
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from scipy.spatial import cKDTree

from hilsplat.base.errors import SceneError
from hilsplat.base.images import to_float
from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import SH_0

logger = logging.getLogger(__name__)

FIRST_OPACITY = 0.1  # 3DGS
MIN_POINTS = 200
"""If there are fewer sparse points than this, random points in front of the cameras are added."""
ADDED_POINTS = 2_000  # number of random points added if there are too few sparse points
RANDOM_POINTS = 10_000  # number of random points if `gaussians.initial` is "random"


@dataclass(frozen=True)
class TrainingView:
    """One view, scaled to the fit's resolution."""

    camera: Camera
    image: UInt8[np.ndarray, "H W 3"]


def load_views(scene: Scene, split: str, image_scale: float) -> list[TrainingView]:
    """Load the images and cameras of a split, scaled by `image_scale` (box filter)."""
    views = []
    for name in scene.views(split):
        image, camera = scene.image(name), scene.cameras[name]
        if image_scale < 1:
            size_hw = tuple(max(1, round(side * image_scale)) for side in image.shape[:2])
            shrunk = Image.fromarray(image).resize(size_hw[::-1], Image.Resampling.BOX)
            image, camera = np.asarray(shrunk), camera.scaled(size_hw)
        views.append(TrainingView(camera, image))
    return views


def camera_extent(cameras: list[Camera]) -> float:
    """Return 1.1 times the largest distance of a camera from the mean camera centre (3DGS); scene units."""
    centres = np.stack([camera.centre for camera in cameras])
    radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    return float(1.1 * radius) if radius > 0 else 1.0


def first_gaussians(
    scene: Scene, cameras: list[Camera], settings: GaussiansSettings, generator: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return round Gaussians at the sparse points, as wide as the mean distance to 3 neighbours (3DGS).

    If there are fewer than MIN_POINTS sparse points, random grey points in front of random cameras are added.
    If `settings.initial` is "random", random points replace all sparse points. If it is "frozen", every
    sparse point becomes one Gaussian, regardless of the number of points.

    Raises:
        SceneError: if points to be frozen are missing or not finite.
    """
    xyz, rgb = scene.points_xyz.astype(np.float64), to_float(scene.points_rgb)
    finite = np.isfinite(xyz).all(axis=1)
    is_random, is_frozen = settings.initial == "random", settings.initial == "frozen"
    if is_frozen and not (len(xyz) and finite.all()):
        raise SceneError(
            f"the points of {scene.name} cannot be used as Gaussians (gaussians.initial: frozen)",
            expected="at least one point, all finite",
            found=f"{len(xyz)} points, {int((~finite).sum())} not finite",
            fix="specify the points as ply_file_path in transforms.json, or set gaussians.initial to points",
        )
    sparse, rgb = xyz[finite], rgb[finite]
    xyz, rgb = (sparse[:0], rgb[:0]) if is_random else (sparse, rgb)
    if len(xyz) > settings.max_gaussians and not is_frozen:
        rows = np.sort(generator.choice(len(xyz), settings.max_gaussians, replace=False))
        xyz, rgb = xyz[rows], rgb[rows]
    if is_random or (len(xyz) < MIN_POINTS and not is_frozen):
        if not is_random:
            logger.warning("%s has only %d sparse points; adding random points", scene.name, len(xyz))
        number = min(RANDOM_POINTS if is_random else ADDED_POINTS, settings.max_gaussians - len(xyz))
        more = _random_points(cameras, sparse, number, generator)
        xyz, rgb = np.concatenate([xyz, more]), np.concatenate([rgb, np.full((number, 3), 0.5, np.float32)])
    n = len(xyz)
    distances = cKDTree(xyz).query(xyz, k=min(4, n))[0].reshape(n, -1)[:, 1:]
    spacing = distances.mean(axis=1) if distances.shape[1] else np.full(n, 0.1)
    # coincident points would get zero width, and outliers would fill the view
    extent = camera_extent(cameras)
    spacing = np.clip(spacing, 1e-4 * extent, 0.1 * extent)
    sh = np.zeros((n, (settings.sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (rgb - 0.5) / SH_0
    return {
        "means": xyz.astype(np.float32),
        "log_scales": np.repeat(np.log(spacing)[:, None], 3, axis=1).astype(np.float32),
        "quats": np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        "opacity_logits": np.full(n, np.log(FIRST_OPACITY / (1 - FIRST_OPACITY)), np.float32),
        "sh": sh,
    }


def _random_points(
    cameras: list[Camera], sparse: np.ndarray, number: int, generator: np.random.Generator
) -> np.ndarray:
    """Sample points in front of random cameras, at depths based on sparse points or the cameras' extent."""
    extent = camera_extent(cameras)
    depths = []
    for camera in cameras:
        z = sparse @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
        depths += z[z > 0].tolist()
    near, far = np.quantile(depths, [0.05, 0.95]) if depths else (0.3 * extent, 2.0 * extent)
    out = np.empty((number, 3))
    for row in range(number):
        camera = cameras[generator.integers(len(cameras))]
        z = generator.uniform(near, far + 1e-6)
        pixel = generator.uniform(size=2) * camera.size_hw[::-1]
        ray = np.linalg.solve(camera.K, [pixel[0], pixel[1], 1.0])
        out[row] = camera.cam_from_world[:3, :3].T @ (z * ray - camera.cam_from_world[:3, 3])
    return out
