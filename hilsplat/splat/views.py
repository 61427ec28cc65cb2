"""Views of a scene at the size at which they are fitted and scored."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene


@dataclass(frozen=True)
class TrainingView:
    """One view at the size at which it is fitted."""

    name: str
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
        views.append(TrainingView(name, camera, image))
    return views


def camera_extent(cameras: list[Camera]) -> float:
    """Return 1.1 times the largest distance of a camera from their common centre (3DGS); scene units."""
    centres = np.stack([camera.centre for camera in cameras])
    radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    return float(1.1 * radius) if radius > 0 else 1.0
