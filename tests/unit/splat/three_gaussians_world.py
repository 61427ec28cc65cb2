"""A world of three coloured Gaussians seen from a ring of cameras: small enough for whole fits."""

from pathlib import Path

import numpy as np

from cpusplat.photometric import psnr
from hilsplat.base.artifacts import write_json
from hilsplat.base.images import write_png
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.api import render
from hilsplat_world.views import numbered_cameras

NUM_VIEWS, SIZE_PX = 9, 48


def ring(number: int, size: int) -> Cameras:
    """Cameras on a circle of radius 3, at height 1.2, that look at the origin; z is up."""
    angles = np.linspace(0, 2 * np.pi, number, endpoint=False)
    sights = [(3 * np.array([np.cos(angle), np.sin(angle), 0.4]), np.zeros(3)) for angle in angles]
    return numbered_cameras(sights, size, fov_deg=45)


def three_gaussians() -> Gaussians:
    """The true Gaussians."""
    return Gaussians(
        np.array([[0.4, 0, 0], [-0.4, 0.2, 0.1], [0, -0.4, 0.3]], np.float32),
        np.log(np.array([[0.3, 0.2, 0.2], [0.15, 0.3, 0.2], [0.2, 0.2, 0.35]], np.float32)),
        np.array([[1.0, 0.2, 0, 0], [1, 0, 0.3, 0], [1, 0, 0, 0]], np.float32),
        np.array([3.0, 3.0, 3.0], np.float32),
        np.array([[[1.5, -1, -1]], [[-1, 1.5, -1]], [[-1, -1, 1.5]]], np.float32),
    )


def three_gaussians_scene(folder: Path, scene_from_source: np.ndarray | None = None) -> Scene:
    """Nine views, two of them held out; eight sparse points."""
    truth, cameras = three_gaussians(), ring(NUM_VIEWS, SIZE_PX)
    for name in cameras.names:
        color = render(truth, cameras[name]).colours.clip(0, 1)
        write_png(folder / "images" / name, np.round(color * 255).astype(np.uint8))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 3)).astype(np.float32)
    split = {name: "test" if row % 4 == 3 else "train" for row, name in enumerate(cameras.names)}
    transform = np.eye(4) if scene_from_source is None else scene_from_source
    grey = np.full((8, 3), 128, np.uint8)
    scene = Scene(folder, "toy/three", "arbitrary", cameras, split, points, grey, transform)
    write_json(folder / "registration.json", {"poses": "imported from sparse/0"})
    scene.save()
    return scene


def mean_psnr(scene: Scene, gaussians: Gaussians) -> float:
    """Mean PSNR of the held-out views, dB."""
    values = []
    for name in scene.views("test"):
        shown = render(gaussians, scene.cameras[name]).colours.clip(0, 1)
        values.append(psnr(shown, scene.image(name).astype(np.float32) / 255))
    return float(np.mean(values))
