"""Segment views that are not key views: one prompt per node, and grid prompts only elsewhere."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int32
from scipy.ndimage import find_objects

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.lineage import require_made_from, sha256_of_file
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.scene.scene import Scene
from hilsplat.segment.sam import point_grid
from hilsplat.segment.stage import run_masks
from hilsplat.semantic_tree.tree import SemanticTree, ViewNodes
from hilsplat.settings import MasksSettings
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights


def run_guided_masks(
    scene_folder: Path,
    gaussians_ply: Path,
    key_masks_folder: Path,
    semantic_tree_folder: Path,
    out: Path,
    cache: Path,
    settings: MasksSettings,
    threads: int,
    memory_mib: float | None = None,
) -> None:
    """Segment the remaining training views with guided prompts (see `segment.stage.segment_views`).

    The masks of the key views are kept unchanged; `semantic_tree_folder` contains their semantic tree.

    Departs: SAM and LangSplat use a grid of prompts in every view (docs/experiments.md compares both).

    Raises:
        MisalignedArtifactError: the tree was computed from different Gaussians.
    """
    scene, gaussians = Scene.load(scene_folder), load_ply(gaussians_ply)
    tree = SemanticTree.load(semantic_tree_folder)
    digest = sha256_of_file(gaussians_ply)
    require_made_from(semantic_tree_folder, gaussians_ply, tree.gaussians_sha256, digest)
    grid = point_grid(settings.points_per_side)

    def points(view: str) -> np.ndarray:
        camera = scene.cameras[view]
        weights = normalised_weights(pixel_weights(gaussians, camera, min_weight=tree.min_weight))
        labels = {
            level: ViewNodes.of(weights, tree.node_of_gaussian[:, level.index]).labels(camera.size_hw)
            for level in LEVELS
        }
        return guided_points(labels, grid, settings.min_area_px)

    run_masks(
        scene_folder, out, cache, settings, threads, memory_mib, prompts=points, finished=key_masks_folder
    )


def guided_points(
    labels: dict[Level, Int32[np.ndarray, "H W"]], grid: Float[np.ndarray, "G 2"], min_area_px: int
) -> Float[np.ndarray, "P 2"]:
    """Return a prompt in the middle of each node, and the grid points not covered by any subpart; (x, y), px.

    The middle is the pixel farthest from the border of the node's region. `labels` contains the node of each
    pixel at each level, -1 for none; `grid` contains points in the unit square.
    """
    middles = []
    for node_of_pixel in labels.values():
        for number, window in enumerate(find_objects(node_of_pixel + 1)):
            if window is None:
                continue
            region = node_of_pixel[window] == number
            if region.sum() < min_area_px:
                continue
            depth = cv2.distanceTransform(np.pad(region, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
            y, x = np.unravel_index(depth.argmax(), depth.shape)
            middles.append((window[1].start + x + 0.5, window[0].start + y + 0.5))
    height, width = labels[Level.WHOLE].shape
    on_grid = grid * (width, height)
    x, y = on_grid.astype(np.int64).T
    unexplained = labels[Level.SUBPART][y, x] == NONE
    points = np.concatenate([np.array(middles, np.float64).reshape(-1, 2), on_grid[unexplained]])
    return points if len(points) else on_grid
