"""Camera construction for the synthetic world."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from hilsplat.scene.cameras import Camera, Cameras

Sight = tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]
"""Position of a camera, and the point that it looks at."""


def looking_at(centre: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """Return `cam_from_world` of an upright camera at `centre` that looks at `target`."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ centre
    return transform


def on_sphere(azimuth_deg: float, elevation_deg: float, distance: float) -> Float[np.ndarray, " 3"]:
    """Return the point at the given distance and direction from the origin."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return distance * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


def arc_azimuths(views: int, arc_deg: float | int) -> Float[np.ndarray, " V"]:
    """Return evenly spaced azimuths centred on 0, degrees; a full ring does not repeat its first azimuth."""
    share = np.arange(views) / (views if arc_deg >= 360 else max(1, views - 1))
    return arc_deg * (share - 0.5)


def numbered_cameras(sights: Sequence[Sight], image_px: int, fov_deg: float | int) -> Cameras:
    """Return upright cameras with square images 000.png, 001.png, ... and the given field of view."""
    views = len(sights)
    focal, middle = image_px / (2 * np.tan(np.radians(fov_deg) / 2)), image_px / 2
    K = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    names = tuple(f"{i:03d}.png" for i in range(views))
    poses = np.stack([looking_at(*sight) for sight in sights])
    return Cameras(names, poses, np.tile(K, (views, 1, 1)), np.full((views, 2), image_px, dtype=np.int32))


def square_camera(sight: Sight, image_px: int, fov_deg: float | int) -> Camera:
    """Return an upright camera with a square image; a sight is its centre and the point that it looks at."""
    return numbered_cameras([sight], image_px, fov_deg)["000.png"]
