"""Highest IoU of any mask or node with each annotated region, by level: an upper limit for any query."""

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
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


def region_fits(
    regions: list[tuple[LabelledRegion, Bool[np.ndarray, "H W"]]],
    masks: Mapping[Level, Bool[np.ndarray, "M P"]],
) -> Iterator[tuple[Level, tuple[float, float, float]]]:
    """Yield the level of each region of a view that has one, and how the masks or nodes fit the region.

    The numbers are the highest IoU with a mask of the same level, that with a mask of any level, and the
    share of the best mask that is in the parent's best mask: 0 if either is missing, nan without a parent.
    """
    flat = np.stack([mask.ravel() for _, mask in regions])
    ious = {level: iou_matrix(flat, masks[level]) for level in LEVELS}
    levelled = [(row, region, region.level) for row, (region, _) in enumerate(regions) if region.level]
    best = {  # if two objects share a path, the path refers to the last object
        region.path: masks[level][int(ious[level][row].argmax())]
        for row, region, level in levelled
        if ious[level][row].max(initial=0) > 0
    }
    for row, region, level in levelled:
        highest = {other: float(ious[other][row].max(initial=0)) for other in LEVELS}
        inside = math.nan
        if len(region.path) > 1:
            parent, child = best.get(region.path[:-1]), best.get(region.path)
            inside = 0.0 if parent is None or child is None else float((parent & child).sum() / child.sum())
        yield level, (highest[level], max(highest.values()), inside)


def summary(fits: list[tuple[float, float, float]]) -> list[str]:
    """Return the number of regions, mean IoUs, shares with an IoU of at least 0.5, and mean containment."""
    best, anywhere, inside = np.array(fits).T
    shares = [best.mean(), (best >= FIT_IOU).mean(), anywhere.mean(), (anywhere >= FIT_IOU).mean()]
    nested = inside[~np.isnan(inside)]
    return [
        str(len(fits)),
        *(f"{share:.3f}" for share in shares),
        f"{nested.mean():.3f}" if len(nested) else "",
    ]


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
    fits = defaultdict[tuple[str, str, Level], list[tuple[float, float, float]]](list)
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
                for level, fit in region_fits(regions, by_level):
                    fits[what, split, level].append(fit)
        counts["views"] = len(views)
    rows = [
        [scene.name, what, split, level.label, *summary(of_group)]
        for (what, split, level), of_group in sorted(fits.items())
    ]
    write_csv(out, COLUMNS, rows)
    return markdown_table(COLUMNS, rows, 4)
