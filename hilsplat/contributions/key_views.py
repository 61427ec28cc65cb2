"""Key views: training views that are segmented first and together show most of the scene."""

import math
from pathlib import Path

import numpy as np

from hilsplat.base.processes import in_order
from hilsplat.contributions.compositing import visible_mass
from hilsplat.scene.scene import Scene
from hilsplat.segment.stage import run_masks, train_views
from hilsplat.settings import MasksSettings
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights

SIDE_PX = 200  # longer side of the renders in which visibility is measured

MIN_WEIGHT = 1 / 255  # smaller weights of a Gaussian at a pixel are ignored

MIN_VISIBLE_PX = 0.02
"""A Gaussian is visible in a view if its mass there exceeds this (0.3 px if the longer side is 800 px)."""


def run_key_masks(
    scene_folder: Path,
    gaussians_ply: Path,
    out: Path,
    cache: Path,
    settings: MasksSettings,
    threads: int,
    memory_mib: float | None = None,
) -> None:
    """Segment only the key views; arguments as in `segment.stage.run_sam_masks`."""
    views = key_views(Scene.load(scene_folder), gaussians_ply, settings.key_views, threads)
    run_masks(scene_folder, out, cache, settings, threads, memory_mib, views)


def key_views(scene: Scene, gaussians_ply: Path, share: float, threads: int = 1) -> list[str]:
    """Return the `share` of the training views (rounded up) that covers the most Gaussians, in camera order.

    Views are chosen greedily. A Gaussian is weighted by its mean visible mass, halved for each chosen view
    that shows it, so that views of uncovered regions are preferred. The result does not depend on `threads`.

    Raises:
        SceneError: there are no training views.
    """
    names, gaussians = train_views(scene), load_ply(gaussians_ply)

    def mass(name: str) -> np.ndarray:
        camera = scene.cameras[name]
        scale = min(1.0, SIDE_PX / max(camera.size_hw))
        height, width = (max(1, round(side * scale)) for side in camera.size_hw)
        return visible_mass(pixel_weights(gaussians, camera.scaled((height, width)), min_weight=MIN_WEIGHT))

    masses = np.stack(list(in_order(mass, names, threads)))
    shows = masses > MIN_VISIBLE_PX
    importance = np.where(shows, masses, 0).sum(axis=0, dtype=np.float64) / np.maximum(shows.sum(axis=0), 1)
    chosen: list[int] = []
    for _ in range(math.ceil(share * len(names))):
        gains = shows @ importance
        gains[chosen] = -1
        best = int(gains.argmax())
        chosen.append(best)
        importance[shows[best]] /= 2
    return [names[number] for number in sorted(chosen)]
