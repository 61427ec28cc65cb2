"""Depth of a synthetic view by ray casting, against which faster depth is checked."""

import numpy as np
from jaxtyping import Float32

from hilsplat.scene.cameras import Camera
from hilsplat.world.render import _rays
from hilsplat.world.scenes.scene import WorldScene


def depth_view(scene: WorldScene, camera: Camera) -> Float32[np.ndarray, "H W"]:
    """Depth along the optical axis through each pixel's centre, scene units; inf where there is nothing."""
    origin, directions = _rays(camera, 1)
    forward = camera.cam_from_world[2, :3].astype(np.float32)
    depth = scene.caster.nearest(origin, directions).distance * (directions @ forward)
    return depth.reshape(camera.size_hw).astype(np.float32)
