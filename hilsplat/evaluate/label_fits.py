"""Highest IoU of any mask or node with each annotated region, by level: an upper limit for any query."""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.progress import stage_log, track
from hilsplat.base.tables import markdown_table, write_csv
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.datasets.labelled import LabelledRegion
from hilsplat.datasets.registry import open_labelled
from hilsplat.evaluate.metrics.masks import iou_matrix
from hilsplat.evaluate.protocols.view_truth import truths_of
from hilsplat.scene.scene import Scene
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.origin import masks_label
from hilsplat.semantic_tree.tree import SemanticTree, ViewNodes
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights

FIT_IOU = 0.5
COLUMNS = (
    *("scene", "what", "views", "level", "regions", "best_iou", "recall"),
    *("any_level_iou", "any_level_recall", "containment"),
)


@dataclass
class Fits:
    """Results for the regions of one level, collected over views."""

    best: list[float] = field(default_factory=list)  # IoU of the best mask or node of the same level, or 0
    anywhere: list[float] = field(default_factory=list)  # IoU of the best mask or node of any level
    # regions with a parent: share of the best mask that is in the parent's best mask; 0 if either is missing
    containment: list[float] = field(default_factory=list)

    def row(self) -> list[str]:
        """Return the number of regions, mean IoUs, shares with an IoU of at least 0.5, and containment."""
        best, anywhere = np.array(self.best), np.array(self.anywhere)
        shares = [best.mean(), (best >= FIT_IOU).mean(), anywhere.mean(), (anywhere >= FIT_IOU).mean()]
        nested = f"{np.mean(self.containment):.3f}" if self.containment else ""
        return [str(len(best)), *(f"{share:.3f}" for share in shares), nested]


def add_view(
    fits: Mapping[Level, Fits],
    regions: list[tuple[LabelledRegion, Bool[np.ndarray, "H W"]]],
    masks: Mapping[Level, Bool[np.ndarray, "M P"]],
) -> None:
    """Compare the regions of a view with the masks or nodes at each level."""
    ious = {
        level: iou_matrix(np.stack([mask.ravel() for _, mask in regions]), masks[level]) for level in LEVELS
    }
    bests: dict[tuple[str, ...], np.ndarray] = {}
    for row, (region, _) in enumerate(regions):
        level = region.level
        if level is None:
            continue
        of_region = ious[level][row]
        fits[level].best.append(float(of_region.max(initial=0)))
        fits[level].anywhere.append(max(float(ious[other][row].max(initial=0)) for other in LEVELS))
        if of_region.max(initial=0) > 0:
            bests[region.path] = masks[level][int(of_region.argmax())]
    for region, _ in regions:  # if two objects share a path, the path refers to the last object
        parent, child = bests.get(region.path[:-1]), bests.get(region.path)
        if region.level is not None and len(region.path) > 1:
            inside = 0.0 if parent is None or child is None else float((parent & child).sum() / child.sum())
            fits[region.level].containment.append(inside)


def nodes_of_view(tree: SemanticTree, weights: sp.csr_matrix) -> dict[Level, np.ndarray]:
    """Return the pixels in which each visible node has more than half of the weight, by level."""
    by_level = {}
    for level in LEVELS:
        view_nodes = ViewNodes.of(weights, tree.node_of_gaussian[:, level.index])
        labels = view_nodes.labels((1, weights.shape[0]))
        by_level[level] = labels == np.unique(labels[labels != NONE])[:, None]
    return by_level


def masks_of_view(path: Path) -> dict[Level, Bool[np.ndarray, "M P"]]:
    """Load the masks of a view by level; a level may have no masks."""
    masks = HierarchicalMasks.load(path)
    pixels = math.prod(masks.size_hw)
    return {level: masks.dense(masks.rows_of(level)).reshape(-1, pixels) for level in LEVELS}


def run_label_fits(
    scene_folder: Path,
    gaussians_ply: Path,
    masks: Path,
    semantic_tree: Path,
    labels: str,
    data_root: Path,
    out: Path,
    threads: int = 1,
) -> str:
    """Compare nodes and masks with the labels of annotated views; write and return a table.

    The labels, such as "annotated/photos/desk", must have levels. Views without masks compare only nodes.

    Raises:
        SceneError: the labels cannot be read or do not fit the scene.
    """
    scene, labelled = Scene.load(scene_folder), open_labelled(labels, data_root)
    views = list(truths_of(labelled, scene, 0))  # raises if they don't fit
    tree, gaussians = SemanticTree.load(semantic_tree), load_ply(gaussians_ply)
    fits = defaultdict[tuple[str, str], dict[Level, Fits]](lambda: {level: Fits() for level in LEVELS})
    with stage_log("label_fits", scene.name) as counts:
        for view in track(views, "views compared"):
            camera = scene.cameras[view]
            drawn = [
                (region, region.on(camera, view).mask(camera.size_hw)) for region in labelled.views[view]
            ]
            regions = [(region, mask) for region, mask in drawn if mask.any()]  # some are outside the view
            if not regions:
                continue
            split = "held out" if scene.split[view] == "test" else "training"
            raw = pixel_weights(gaussians, camera, min_weight=tree.min_weight, threads=threads)
            by_source = {"nodes": nodes_of_view(tree, normalised_weights(raw))}
            if (masks / f"{view}.npz").is_file():
                by_source[f"masks, {masks_label(masks)}"] = masks_of_view(masks / f"{view}.npz")
            for what, by_level in by_source.items():
                add_view(fits[what, split], regions, by_level)
        counts["views"] = len(views)
    rows = [
        [scene.name, what, split, level.label, *fit[level].row()]
        for (what, split), fit in sorted(fits.items())
        for level in LEVELS
        if fit[level].best
    ]
    write_csv(out, COLUMNS, rows)
    return markdown_table(COLUMNS, rows, 4)
