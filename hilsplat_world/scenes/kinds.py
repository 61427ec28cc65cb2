"""Kinds of synthetic scene, which build scenes and choose cameras, and the reserved scene seeds."""

from collections.abc import Callable
from typing import NamedTuple

from hilsplat.scene.cameras import Cameras
from hilsplat_world.scenes import room, street, tabletop
from hilsplat_world.scenes.scene import WorldScene
from hilsplat_world.views import Sight, numbered_cameras


class SceneKind(NamedTuple):
    """One kind of scene.

    `sights` returns cameras and their field of view in degrees for (scene, views, arc_deg). The cameras are
    jittered with the scene's seed, and close enough together for structure from motion.
    """

    build: Callable[[int, int], WorldScene]  # from (seed, objects)
    sights: Callable[[WorldScene, int, float | int], tuple[list[Sight], float]]


KINDS: dict[str, SceneKind] = {
    "tabletop": SceneKind(tabletop.build_tabletop, tabletop.ring_sights),
    "room": SceneKind(room.build_room, room.loop_sights),
    "street": SceneKind(street.build_street, street.drive_sights),
}
"""Scene kinds by name in the scene sheet."""


def build_scene(kind: str, seed: int, objects: int) -> WorldScene:
    """Build a scene with a number of objects (on a street, vehicles and people).

    The same seed and number always yield the same scene.
    """
    return KINDS[kind].build(seed, objects)


def scene_cameras(scene: WorldScene, views: int, image_px: int, arc_deg: float | int) -> Cameras:
    """Return the views of a scene that the world stage renders: square images 000.png, 001.png, ..."""
    sights, fov_deg = KINDS[scene.kind].sights(scene, views, arc_deg)
    return numbered_cameras(sights, image_px, fov_deg)


TRAINING_SEEDS = range(1_000_000, 2_000_000)  # scenes on which the small embedded models are trained

SPLITS = {"training": TRAINING_SEEDS, "development": range(100, 200), "benchmark": range(200, 300)}
"""Scenes for training, for choosing settings, and for reported results; no scene has two of these uses."""


def split_of_seed(seed: int) -> str:
    """Return "training", "development", "benchmark", or "free" for a seed in no split."""
    return next((split for split, seeds in SPLITS.items() if seed in seeds), "free")
