"""Kinds of synthetic scene, with the functions that build and view them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hilsplat.base.errors import SceneError
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.world.scenes import room, street, tabletop
from hilsplat.world.scenes.scene import WorldScene


class SceneKind(NamedTuple):
    """One kind of scene.

    Attributes:
        build: builds a scene, (seed, objects).
        cameras: returns the views of a scene, (scene, views, image_px, arc_deg): square images 000.png,
            001.png, ..., jittered by the scene's seed, and close enough for structure from motion.
        training_camera: returns a random camera for training, (scene, rng, image_px).
    """

    build: Callable[[int, int], WorldScene]
    cameras: Callable[[WorldScene, int, int, float | int], Cameras]
    training_camera: Callable[[WorldScene, np.random.Generator, int], Camera]


KINDS: dict[str, SceneKind] = {
    "tabletop": SceneKind(tabletop.build_tabletop, tabletop.ring_cameras, tabletop.training_camera),
    "room": SceneKind(room.build_room, room.loop_cameras, room.training_camera),
    "street": SceneKind(street.build_street, street.drive_cameras, street.training_camera),
}
"""Scene kinds by their name in the scene sheet."""


def build_scene(kind: str, seed: int, objects: int) -> WorldScene:
    """Build a scene with a number of objects; on a street, of vehicles and people.

    The same seed and number give the same scene.

    Raises:
        SceneError: if the kind is unknown or a number is out of range.
    """
    if kind not in KINDS:
        raise SceneError(
            f"unknown kind of synthetic scene {kind!r}",
            expected=f"one of: {', '.join(KINDS)}",
            fix="name a known kind in the scene sheet, as in world:tabletop:201",
        )
    if seed < 0 or objects < 1:
        raise SceneError(
            "a synthetic scene needs a seed of at least 0 and at least one object",
            found=f"seed {seed}, {objects} objects",
        )
    return KINDS[kind].build(seed, objects)


def scene_cameras(scene: WorldScene, views: int, image_px: int, arc_deg: float | int) -> Cameras:
    """Return the views of a scene that the world stage renders."""
    return KINDS[scene.kind].cameras(scene, views, image_px, arc_deg)


def training_camera(scene: WorldScene, rng: np.random.Generator, image_px: int) -> Camera:
    """Return a random view of a training scene."""
    return KINDS[scene.kind].training_camera(scene, rng, image_px)
