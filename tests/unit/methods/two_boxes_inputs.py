"""Inputs of methods from the world with two boxes."""

from dataclasses import dataclass

import numpy as np

from hilsplat.contributions.compositing import normalised_weights
from hilsplat.field.code import LinearCode
from hilsplat.methods.method import MethodInputs
from hilsplat.scene.cameras import Camera
from tests.unit.two_boxes_world import HEIGHT, REGIONS, WIDTH, TwoBoxes, two_boxes_weights


@dataclass(frozen=True)
class BoxesInputs(MethodInputs):
    """Inputs of the world with two boxes; codes are the one-hot names of regions."""

    world: TwoBoxes | None = None

    @property
    def latents(self):
        return np.eye(len(REGIONS), dtype=np.float32)[np.concatenate(list(self.world.regions.values()))]

    def linear_code(self, method):
        return LinearCode(np.full(len(REGIONS), 0.1, np.float32), np.eye(len(REGIONS), dtype=np.float32))

    def view_weights(self, view):
        return normalised_weights(two_boxes_weights(self.world.views.index(view)))

    def view_camera(self, view):
        ahead = np.eye(4)
        ahead[:3, 3] = self.world.views.index(view), 0, 1
        return Camera(view, ahead, np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), (HEIGHT, WIDTH))


def two_boxes_inputs(world, contributions, threads=1):
    """Inputs of methods."""
    return BoxesInputs(world.scene, world.ply, world.masks, contributions, world.folder, threads, world)
