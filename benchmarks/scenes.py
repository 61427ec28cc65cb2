"""Random scenes that take as long to render as fitted ones: each pixel blends 33 to 43 Gaussians."""

import math

import numpy as np

from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians

# name of a scene -> number of Gaussians, image height and width in px
SIZES = {"20k 256x256": (20_000, (256, 256)), "100k 256x256": (100_000, (256, 256))}
SIZES |= {"20k 800x600": (20_000, (600, 800)), "100k 800x600": (100_000, (600, 800))}

WIDTH_SHARE = 1.15 / 256  # median standard deviation of 20k Gaussians, as a share of the image's width
SPREAD = 0.9  # standard deviation of the log of a Gaussian's width along an axis


def random_scene(
    num_gaussians: int, size_hw: tuple[int, int], *, seed: int = 0, sh_degree: int = 3
) -> tuple[Gaussians, Camera]:
    """Return anisotropic Gaussians spread evenly over a camera's frustum, and the camera.

    Widths are log-normal and inversely proportional to the root of the number; opacities are logit-normal.
    The average alpha of an image is 0.95 to 0.99.
    """
    generator = np.random.default_rng(seed)
    height, width = size_hw
    focal = 0.9 * width
    depth = generator.uniform(2, 6, num_gaussians)
    x_px = generator.uniform(-0.05, 1.05, num_gaussians) * width - width / 2
    y_px = generator.uniform(-0.05, 1.05, num_gaussians) * height - height / 2
    scale = WIDTH_SHARE * math.sqrt(20_000 / num_gaussians) * width / focal * depth
    arrays = (
        np.stack([x_px / focal * depth, y_px / focal * depth, depth], axis=1),
        np.log(scale)[:, None] + SPREAD * generator.normal(size=(num_gaussians, 3)),
        generator.normal(size=(num_gaussians, 4)),
        generator.normal(size=num_gaussians),
        generator.normal(size=(num_gaussians, (sh_degree + 1) ** 2, 3)) * 0.3,
    )
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    gaussians = Gaussians(*(values.astype(np.float32) for values in arrays))
    return gaussians, Camera("view", np.eye(4), K, size_hw)
