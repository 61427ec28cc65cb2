"""Cameras of room scenes: a loop for structure from motion, and random ones for training."""

import numpy as np
from jaxtyping import Float

from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.world.scenes.floorplan import Room
from hilsplat.world.scenes.scene import WorldScene
from hilsplat.world.views import arc_azimuths, looking_at, numbered_cameras, pinhole

FOV_DEG = 62.0
EYE_HEIGHTS = (1.34, 1.7)
"""Alternating heights of the cameras, m; the difference adds parallax that the loop alone lacks."""
PATH_SHARE = 0.27
"""Semi-axes of the camera loop, as shares of the room's width and depth."""
LOOK_AT_Z = 0.78


def path_points(room: Room, azimuths_deg: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 2"]:
    """Return x and y of points on the camera loop, an ellipse about the middle of the room."""
    angle = np.radians(azimuths_deg)
    axes = PATH_SHARE * np.array([room.width, room.depth])
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) * axes


def room_of(scene: WorldScene) -> Room:
    """Return the interior dimensions of a room scene."""
    high = scene.triangles.reshape(-1, 3).max(axis=0)
    return Room(2 * float(high[0]), 2 * float(high[1]), float(high[2]))


def loop_cameras(scene: WorldScene, views: int, image_px: int, arc_deg: float | int = 360.0) -> Cameras:
    """Return cameras on a loop through the room that look across its middle from two alternating heights.

    The views show the far wall with everything in front of it, and the middle from all sides. A camera that
    rotates in place and looks outwards would give no parallax.
    """
    rng = np.random.default_rng([scene.seed, 25])
    spots = path_points(room_of(scene), arc_azimuths(views, arc_deg) + rng.uniform(-1, 1, views))
    transforms = []
    for i in range(views):
        centre = np.array([*spots[i], EYE_HEIGHTS[i % 2] + rng.uniform(-0.03, 0.03)])
        target = np.array([*(-0.5 * spots[i]), LOOK_AT_Z]) + rng.uniform(-0.04, 0.04, 3)
        transforms.append(looking_at(centre, target))
    return numbered_cameras(transforms, pinhole(image_px, FOV_DEG), image_px)


def training_camera(scene: WorldScene, rng: np.random.Generator, image_px: int = 256) -> Camera:
    """Return a random camera for training: a third as in `loop_cameras`, the others near one object.

    The position is inside the room and outside all objects.
    """
    room = room_of(scene)
    if rng.random() < 1 / 3:
        spot = path_points(room, np.array([rng.uniform(0, 360)]))[0]
        centre = np.array([*spot, rng.uniform(1.3, 1.78)])
        target = np.array([*(-0.5 * spot), LOOK_AT_Z]) + rng.uniform(-0.3, 0.3, 3)
    else:
        thing = scene.placed[int(rng.integers(len(scene.placed)))]
        target = np.array([*thing.centre_xy, thing.base_z + 0.5 * thing.height]) + rng.uniform(-0.1, 0.1, 3)
        size = max(thing.footprint, thing.height / 2)
        centre = _free_centre(scene, room, target, size, rng)
    K = pinhole(image_px, rng.uniform(54, 66))
    return Camera("random.png", looking_at(centre, target), K, (image_px, image_px))


def _free_centre(
    scene: WorldScene, room: Room, target: np.ndarray, size: float, rng: np.random.Generator
) -> np.ndarray:
    """Return a position outside all objects from which an object of this size fills much of a view."""
    things = [scene.triangles[scene.node_ids[:, 0] == thing.node] for thing in scene.placed]
    boxes = [(corners.min(axis=(0, 1)), corners.max(axis=(0, 1))) for corners in things]
    half = np.array([room.width, room.depth]) / 2 - 0.2
    for _ in range(200):
        azimuth, distance = rng.uniform(0, 2 * np.pi), size * rng.uniform(1.7, 3.2) + 0.35
        flat = target[:2] + distance * np.array([np.cos(azimuth), np.sin(azimuth)])
        centre = np.array([*flat, np.clip(target[2] + rng.uniform(0.05, 0.6) * distance, 0.45, 1.9)])
        if (np.abs(flat) < half).all() and all(
            ((centre < low - 0.12) | (centre > high + 0.12)).any() for low, high in boxes
        ):
            return centre
    # Near an object enclosed by furniture, only the loop is certain to be free.
    spot = path_points(room, np.array([rng.uniform(0, 360)]))[0]
    return np.array([*spot, rng.uniform(1.3, 1.75)])
