"""A world of three coloured Gaussians seen from a ring of cameras: small enough for whole fits."""

from pathlib import Path

import numpy as np

from hilsplat.base.artifacts import write_json
from hilsplat.base.images import write_png
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.photometric import psnr
from hilsplat.splat.rasterise.api import render

NUM_VIEWS, SIZE_PX = 9, 48


def looking_at_the_origin(centre: np.ndarray) -> np.ndarray:
    """World-to-camera matrix of a level camera at `centre`; z is up."""
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def ring(number: int, size: int) -> Cameras:
    """Cameras on a circle of radius 3, at height 1.2, that look at the origin; z is up."""
    angles = np.linspace(0, 2 * np.pi, number, endpoint=False)
    centres = [3 * np.array([np.cos(angle), np.sin(angle), 0.4]) for angle in angles]
    poses = [looking_at_the_origin(centre) for centre in centres]
    K = np.array([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1.0]])
    names = tuple(f"{view:03d}.png" for view in range(number))
    return Cameras(names, np.stack(poses), np.tile(K, (number, 1, 1)), np.full((number, 2), size, np.int32))


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
        color = render(truth, cameras[name]).color.clip(0, 1)
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
        shown = render(gaussians, scene.cameras[name]).color.clip(0, 1)
        values.append(psnr(shown, scene.image(name).astype(np.float32) / 255))
    return float(np.mean(values))
