"""Key views: training views that are segmented first and together show most of the scene."""

import heapq
import math
from pathlib import Path

import numpy as np

from hilsplat.base.processes import in_order
from hilsplat.contributions.compositing import visible_mass
from hilsplat.scene.scene import Scene
from hilsplat.segment.stage import train_views
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights

SIDE_PX = 200  # longer side of the renders in which visibility is measured
MIN_WEIGHT = 1 / 255  # smaller weights of a Gaussian at a pixel are ignored

MIN_VISIBLE_PX = 0.02
"""A Gaussian is visible in a view if its mass there exceeds this (0.3 px if the longer side is 800 px)."""


def key_views(scene: Scene, gaussians_ply: Path, share: float, threads: int = 1) -> list[str]:
    """Return the `share` of the training views (rounded up) that covers the most Gaussians, in camera order.

    Views are chosen greedily. A Gaussian is weighted by its mean visible mass, halved for each chosen view
    that shows it, so that views of uncovered regions are preferred. The result does not depend on `threads`.

    Raises:
        SceneError: there are no training views.
    """
    names, gaussians = train_views(scene), load_ply(gaussians_ply)

    def shown(name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gaussians that a view shows, and their mass there."""
        camera = scene.cameras[name]
        scale = min(1.0, SIDE_PX / max(camera.size_hw))
        height, width = (max(1, round(side * scale)) for side in camera.size_hw)
        weights = pixel_weights(gaussians, camera.scaled((height, width)), min_weight=MIN_WEIGHT)
        mass = visible_mass(weights)
        rows = np.flatnonzero(mass > MIN_VISIBLE_PX)
        return rows, mass[rows]

    total, views_of = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    rows_of = []
    for rows, mass in in_order(shown, names, threads):
        total[rows] += mass
        views_of[rows] += 1
        rows_of.append(rows)
    importance = total / np.maximum(views_of, 1)
    # Gains only fall, so a view whose gain is still the highest after an update is the best of all.
    queue = [(-importance[rows].sum(), number) for number, rows in enumerate(rows_of)]
    heapq.heapify(queue)
    chosen: list[int] = []
    while len(chosen) < math.ceil(share * len(names)):
        _, number = heapq.heappop(queue)
        gain = importance[rows_of[number]].sum()
        if queue and (-gain, number) > queue[0]:
            heapq.heappush(queue, (-gain, number))
            continue
        chosen.append(number)
        importance[rows_of[number]] /= 2
    return [names[number] for number in sorted(chosen)]
