"""Cameras of the synthetic world: rings and arcs around the table, and random ones for training."""

import numpy as np
from jaxtyping import Float

from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.world.scenes import TABLE_RADIUS, WorldScene

FOV_DEG = 50.0
ELEVATIONS_DEG = (24.0, 46.0)
DISTANCE = 2.25 * TABLE_RADIUS
LOOK_AT_Z = 0.16


def looking_at(centre: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """Transform `cam_from_world` of an upright camera at `centre` that looks at `target`."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ centre
    return transform


def pinhole(image_px: int, fov_deg: float | int = FOV_DEG) -> Float[np.ndarray, "3 3"]:
    """Intrinsics of a square image with the given field of view, px."""
    focal = image_px / (2 * np.tan(np.radians(fov_deg) / 2))
    return np.array([[focal, 0.0, image_px / 2], [0.0, focal, image_px / 2], [0.0, 0.0, 1.0]])


def _on_sphere(azimuth_deg: float, elevation_deg: float, distance: float) -> Float[np.ndarray, " 3"]:
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return distance * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


def ring_cameras(seed: int, views: int, image_px: int, arc_deg: float | int = 360.0) -> Cameras:
    """Cameras around the table at two alternating elevations, slightly jittered.

    Neighbours should be at most 9 degrees apart, or structure from motion fails (measured).

    Args:
        seed: of the jitter.
        views: number of cameras, named 000.png, 001.png, ...
        image_px: height and width.
        arc_deg: azimuth covered, centred on +x, where the objects' fronts tend to face; a full ring
            does not repeat its first azimuth.
    """
    rng = np.random.default_rng([seed, 5])
    share = np.arange(views) / (views if arc_deg >= 360 else max(1, views - 1))
    target = np.array([0.0, 0.0, LOOK_AT_Z])
    transforms = []
    for i in range(views):
        azimuth = arc_deg * (share[i] - 0.5) + rng.uniform(-1, 1)
        elevation = ELEVATIONS_DEG[i % 2] + rng.uniform(-1.5, 1.5)
        centre = target + _on_sphere(azimuth, elevation, DISTANCE * rng.uniform(0.97, 1.03))
        transforms.append(looking_at(centre, target + rng.uniform(-0.03, 0.03, 3)))
    return Cameras(
        tuple(f"{i:03d}.png" for i in range(views)),
        np.stack(transforms),
        np.tile(pinhole(image_px), (views, 1, 1)),
        np.full((views, 2), image_px, dtype=np.int32),
    )


def random_camera(scene: WorldScene, rng: np.random.Generator, image_px: int = 256) -> Camera:
    """A random camera for training: like those of `ring_cameras`, and closer ones on one object.

    Half of them see the whole table, half look at an object from nearer by.
    """
    azimuth, elevation = rng.uniform(0, 360), rng.uniform(18, 55)
    if scene.placed and rng.random() < 0.5:
        thing = scene.placed[int(rng.integers(len(scene.placed)))]
        target = np.array([*thing.centre_xy, thing.height * 0.45]) + rng.uniform(-0.08, 0.08, 3)
        distance = DISTANCE * rng.uniform(0.5, 0.85)
    else:
        target = np.array([0.0, 0.0, LOOK_AT_Z]) + rng.uniform(-0.15, 0.15, 3) * np.array([1, 1, 0.5])
        distance = DISTANCE * rng.uniform(0.85, 1.12)
    centre = target + _on_sphere(azimuth, elevation, distance)
    return Camera(
        "random.png", looking_at(centre, target), pinhole(image_px, rng.uniform(46, 54)), (image_px, image_px)
    )
