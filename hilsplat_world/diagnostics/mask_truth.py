"""Fit of a synthetic scene's masks to the ground-truth regions, a diagnostic that isn't used in tables."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int, Int64
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from hilsplat.base.artifacts import read_index
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.progress import stage_log, track
from hilsplat.base.tables import markdown_table, write_csv
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.query.pictures import grey, save_with_pdf, show
from hilsplat.scene.scene import Scene
from hilsplat.segment.masks import HierarchicalMasks, region_ious
from hilsplat.segment.origin import masks_label
from hilsplat.segment.pictures import paint_level
from hilsplat_world.diagnostics.world_consistency import load_masks

MIN_PX = 100  # smaller ground-truth regions are not scored, because their IoU is not informative
FIT_IOU = 0.5
COLUMNS = ("scene", "masks", "level", "views", "regions", "best_iou", "recall", "masks_a_view", "precision")
COLOURS = "RdYlGn"


@dataclass(frozen=True)
class ViewFit:
    """Fit of one view's masks at one level to the ground-truth regions of that level."""

    ids: Int64[np.ndarray, " r"]  # true nodes with a region of at least `MIN_PX`
    best: Float32[np.ndarray, " r"]  # IoU of each node's best mask, 0 if there are no masks
    masks: int  # number of masks
    fitting: int  # number of masks with an IoU of at least 0.5 with a region of any size


def fit_of_level(masks: HierarchicalMasks, level: Level, labels: Int[np.ndarray, "H W"]) -> ViewFit:
    """Compare a view's masks of a level with the ground-truth regions, the node of each pixel."""
    rows = masks.rows_of(level)
    ids, areas, ious = region_ious(labels, masks.dense(rows))
    scored = areas >= MIN_PX
    best = ious[scored].max(axis=1, initial=0)
    fitting = int((ious.max(axis=0, initial=0) >= FIT_IOU).sum())
    return ViewFit(ids[scored], best, len(rows), fitting)


def run_mask_truth(scene_folder: Path, truth_folder: Path, masks_folder: Path, out: Path) -> str:
    """Write a table of all views and a picture of the median and worst views; return a Markdown table.

    The PDF and the CSV table are written beside the PNG.

    Raises:
        MisalignedArtifactError: masks and labels differ in size.
    """
    scene, truth = Scene.load(scene_folder), HierarchyAnnotations.load(truth_folder)
    with stage_log("mask_truth", scene.name) as counts:
        fits = {}
        for view in track(list(read_index(masks_folder)["views"]), "views compared"):
            labels = {level: truth.label_image(view, level) for level in LEVELS}
            masks = load_masks(masks_folder, view, labels[Level.WHOLE].shape)
            fits[view] = {level: fit_of_level(masks, level, labels[level]) for level in LEVELS}
        counts["views"] = len(fits)
        rows = []
        for level in LEVELS:  # means are over regions, not over views
            of_level = [fit[level] for fit in fits.values()]
            best = np.concatenate([fit.best for fit in of_level])
            num_masks = sum(fit.masks for fit in of_level)
            iou, recall = (best.mean(), (best >= FIT_IOU).mean()) if len(best) else (np.nan, np.nan)
            precision = sum(fit.fitting for fit in of_level) / num_masks if num_masks else np.nan
            numbers = [str(len(of_level)), str(len(best)), f"{iou:.4f}", f"{recall:.4f}"]
            numbers += [f"{num_masks / len(of_level):.1f}", f"{precision:.4f}"]
            rows.append([scene.name, masks_label(masks_folder), level.label, *numbers])
        save_with_pdf(draw_fits(scene, truth, masks_folder, fits), out)
        write_csv(Path(out).with_suffix(".csv"), COLUMNS, rows)
    return markdown_table(COLUMNS, rows, 3)


def median_and_worst(fits: Mapping[str, dict[Level, ViewFit]]) -> list[str]:
    """Return the views whose mean IoU over all regions is the median and the lowest."""

    def mean_of(view: str) -> float:
        best = np.concatenate([fit.best for fit in fits[view].values()])
        return float(best.mean()) if len(best) else 1.0

    order = sorted(fits, key=lambda view: (mean_of(view), view))
    return list(dict.fromkeys([order[len(order) // 2], order[0]]))


def draw_fits(
    scene: Scene, truth: HierarchyAnnotations, masks_folder: Path, fits: Mapping[str, dict[Level, ViewFit]]
) -> Figure:
    """Draw two rows per view: masks by level, then ground-truth regions coloured by their best IoU."""
    views = median_and_worst(fits)
    tall, wide = 2 * len(views), 1 + len(LEVELS)
    height, width = scene.cameras[views[0]].size_hw
    figure = Figure(figsize=(3.1 * wide, tall * (3.1 * height / width + 0.3)), layout="constrained")
    axes = figure.subplots(tall, wide, squeeze=False)
    for number, view in enumerate(views):
        image = scene.image(view)
        masks = HierarchicalMasks.load(Path(masks_folder) / f"{view}.npz")
        above, below = axes[2 * number], axes[2 * number + 1]
        show(above[0], image, f"{view}: {('median view', 'worst view')[number]}")
        for level in LEVELS:
            fit = fits[view][level]
            column = 1 + level.index
            show(above[column], paint_level(image, masks, level), f"{level.label}: {fit.masks} masks")
            title = f"{len(fit.best)} regions"
            if len(fit.best):
                title += f", {(fit.best >= FIT_IOU).sum()} found, mean IoU {fit.best.mean():.2f}"
            show(below[column], paint_fits(image, truth.label_image(view, level), fit), title)
        below[0].set_axis_off()
        scale = below[0].inset_axes((0.1, 0.5, 0.8, 0.05))
        bar = figure.colorbar(ScalarMappable(cmap=COLOURS), cax=scale, orientation="horizontal")
        bar.ax.tick_params(labelsize=7)
        bar.set_label("IoU of each true region\nwith its best mask", fontsize=8)
    return figure


def paint_fits(image: np.ndarray, labels: np.ndarray, fit: ViewFit) -> np.ndarray:
    """Outline ground-truth regions and colour each by its best mask's IoU; unscored regions stay grey."""
    painted = 0.5 * grey(image)
    for node, value in zip(fit.ids, fit.best, strict=True):
        colour = np.array(colormaps[COLOURS](float(value))[:3]) * 255
        inside = labels == node
        painted[inside] = 0.3 * grey(image)[inside] + 0.7 * colour
    edge = np.zeros(labels.shape, dtype=bool)
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edge[1:] |= labels[1:] != labels[:-1]
    painted[edge] = 255
    return painted.clip(0, 255).astype(np.uint8)
