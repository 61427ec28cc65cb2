"""Random cameras of training scenes, far more varied than those of scenes that are scored."""

import numpy as np

from hilsplat.scene.cameras import Camera
from hilsplat_world.scenes import room, tabletop
from hilsplat_world.scenes.floorplan import Room
from hilsplat_world.scenes.scene import WorldScene
from hilsplat_world.scenes.street import DRIVE_X, FRONT
from hilsplat_world.views import Sight, on_sphere, square_camera


def training_camera(scene: WorldScene, rng: np.random.Generator, image_px: int) -> Camera:
    draw = {"tabletop": _table_sight, "room": _room_sight, "street": _street_sight}[scene.kind]
    sight, fov_deg = draw(scene, rng)
    return square_camera(sight, image_px, fov_deg)


def _table_sight(scene: WorldScene, rng: np.random.Generator) -> tuple[Sight, float]:
    """Draw a camera that shows the whole table or, in half of the draws, one object."""
    azimuth, elevation, fov_deg = rng.uniform(0, 360), rng.uniform(16, 60), rng.uniform(42, 64)
    # A narrower field of view is seen from further away, which keeps sizes in the image.
    nearer = np.tan(np.radians(tabletop.FOV_DEG / 2)) / np.tan(np.radians(fov_deg / 2))
    if scene.placed and rng.random() < 0.5:
        thing = scene.placed[int(rng.integers(len(scene.placed)))]
        target = np.array([*thing.centre_xy, thing.height * 0.45]) + rng.uniform(-0.08, 0.08, 3)
        distance = nearer * tabletop.DISTANCE * rng.uniform(0.45, 0.85)
    else:
        shift = rng.uniform(-0.15, 0.15, 3) * np.array([1, 1, 0.5])
        target = np.array([0.0, 0.0, tabletop.LOOK_AT_Z]) + shift
        distance = nearer * tabletop.DISTANCE * rng.uniform(0.85, 1.12)
    return (target + on_sphere(azimuth, elevation, distance), target), fov_deg


def _room_sight(scene: WorldScene, rng: np.random.Generator) -> tuple[Sight, float]:
    """Draw a camera: a third resemble those of `room.loop_sights`; the others are close to one object.

    The position is inside the room and outside all objects.
    """
    shell = room.room_of(scene)
    if rng.random() < 1 / 3:
        spot = room.path_points(shell, rng.uniform(0, 360, 1))[0]
        centre = np.array([*spot, rng.uniform(1.3, 1.78)])
        target = np.array([*(-0.5 * spot), room.LOOK_AT_Z]) + rng.uniform(-0.3, 0.3, 3)
    else:
        thing = scene.placed[int(rng.integers(len(scene.placed)))]
        target = np.array([*thing.centre_xy, thing.base_z + 0.5 * thing.height]) + rng.uniform(-0.1, 0.1, 3)
        size = max(thing.footprint, thing.height / 2)
        centre = _free_centre(scene, shell, target, size, rng)
    return (centre, target), rng.uniform(54, 66)


def _free_centre(
    scene: WorldScene, shell: Room, target: np.ndarray, size: float, rng: np.random.Generator
) -> np.ndarray:
    """Return a position, outside all objects, from which an object of this size fills much of a view."""
    things = [scene.triangles[scene.node_ids[:, 0] == thing.node] for thing in scene.placed]
    boxes = [(corners.min(axis=(0, 1)), corners.max(axis=(0, 1))) for corners in things]
    half = np.array([shell.width, shell.depth]) / 2 - 0.2
    for _ in range(200):
        azimuth, distance = rng.uniform(0, 2 * np.pi), size * rng.uniform(1.7, 3.2) + 0.35
        flat = target[:2] + distance * np.array([np.cos(azimuth), np.sin(azimuth)])
        centre = np.array([*flat, np.clip(target[2] + rng.uniform(0.05, 0.6) * distance, 0.45, 1.9)])
        if (np.abs(flat) < half).all() and all(
            ((centre < low - 0.12) | (centre > high + 0.12)).any() for low, high in boxes
        ):
            return centre
    # No free position near the object was found; the loop is always free.
    return np.array([*room.path_points(shell, rng.uniform(0, 360, 1))[0], rng.uniform(1.3, 1.75)])


def _street_sight(scene: WorldScene, rng: np.random.Generator) -> tuple[Sight, float]:
    fov_deg = float(rng.uniform(56, 66))
    sight = _close_up(scene, rng) if rng.random() < 0.5 else None
    if sight is None:
        centre = np.array([rng.uniform(DRIVE_X[0], 14), rng.uniform(-2.4, -0.8), rng.uniform(1.5, 2.4)])
        yaw = rng.uniform(-60, 60) if rng.random() < 0.85 else rng.uniform(90, 270)
        sight = centre, centre + on_sphere(yaw, rng.uniform(-6, 6), 1.0)
    return sight, fov_deg


def _close_up(scene: WorldScene, rng: np.random.Generator) -> Sight | None:
    """Return a camera on the road side of a random unoccluded object, or None if no object qualifies."""
    wholes = sorted(set(np.unique(scene.node_ids[:, 0]).tolist()) - scene.background)
    for _ in range(30):
        node = wholes[int(rng.integers(len(wholes)))]
        if scene.nodes[node].text == "building" and rng.random() < 0.6:
            continue  # houses outnumber all other objects
        corners = scene.triangles[scene.node_ids[:, 0] == node].reshape(-1, 3).astype(np.float64)
        low, high = corners.min(axis=0), corners.max(axis=0)
        if low[0] > 30 or high[0] < -16:
            continue
        target = low + (high - low) * rng.uniform(0.35, 0.65, 3)
        size = float(np.linalg.norm(high - low))
        toward = np.degrees(np.arctan2(-target[1], 0.3)) + rng.uniform(-70, 70)
        away = rng.uniform(0.7, 1.5) * size
        centre = target + away * on_sphere(float(toward), 0.0, 1.0)
        centre[2] = rng.uniform(0.9, 2.6)
        inside = (low < centre) & (centre < high)
        if abs(centre[1]) > FRONT - 0.5 or inside.all():
            continue
        if _sees(scene, centre, corners, node, rng):
            return centre, target
    return None


def _sees(
    scene: WorldScene, centre: np.ndarray, corners: np.ndarray, node: int, rng: np.random.Generator
) -> bool:
    """Return whether most of an object's corners are visible from a point or hidden only by the object."""
    chosen = corners[rng.integers(len(corners), size=40)]
    directions = chosen - centre
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hit = scene.caster.nearest(centre.astype(np.float32)[None], directions.astype(np.float32)).triangle
    return bool(((hit >= 0) & (scene.node_ids[hit, 0] == node)).mean() > 0.6)
