"""The panel of a scene: photograph, masks, field, and answers to queries."""

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from matplotlib.figure import Figure, FigureBase

from hilsplat.base.artifacts import read_index
from hilsplat.base.images import read_image, write_webp
from hilsplat.base.levels import LEVELS, Level, path_of
from hilsplat.base.progress import stage_log, track
from hilsplat.datasets.registry import open_labelled
from hilsplat.evaluate.metrics.masks import iou
from hilsplat.evaluate.metrics.relevancy_rule import SmoothedRelevancy, relevancy_answer
from hilsplat.evaluate.protocols.answers import peaks_of_answer
from hilsplat.evaluate.protocols.view_truth import ViewTruth, truths_of
from hilsplat.evaluate.protocols.views import rule_of
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.node_search import NodeHits
from hilsplat.query.pictures import (
    TITLE_LETTERS,
    label_left,
    paint_answer,
    paint_relevancy,
    save_with_pdf,
    show,
)
from hilsplat.scene.finished import SceneParts
from hilsplat.scene.scene import Scene
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.origin import made_from_truth, masks_label
from hilsplat.segment.pictures import paint_level
from hilsplat.settings import EvaluateSettings, FiguresSettings

WIDTH_IN = 13.0
RING = {"markersize": 9, "markerfacecolor": "none", "markeredgecolor": "white", "markeredgewidth": 1.8}
"""Marker style of the localization point."""


@dataclass(frozen=True)
class Shown:
    """One row of the panel: a query in a view."""

    text: str  # texts separated by ">" form a path
    path: tuple[str, ...]  # chain of texts that starts at the whole; without annotations, the query's texts
    level: Level | None  # of the annotation, if any
    view: str
    truth: Bool[np.ndarray, "H W"] | None  # ground-truth region; None if unknown

    def hits(self, answers: LanguageScene, *, by_path: bool = False) -> NodeHits:
        """Return the tree's answer to the text alone, or to the whole path.

        A query without an annotated level is used as written.
        """
        is_exact = self.level is None or by_path
        return answers.select(self.path if is_exact else self.path[-1:], level=self.level, view=self.view)

    @property
    def title(self) -> str:
        return self.view if self.truth is None else f"truth, {self.view}"

    def score(self, mask: Bool[np.ndarray, "H W"]) -> str:
        """Return the IoU of an answer, for its title; empty if the ground truth is unknown."""
        return "" if self.truth is None else f"IoU {iou(mask, self.truth):.2f}"

    def tree_mask(self, answers: LanguageScene, *, by_path: bool = False) -> Bool[np.ndarray, "H W"]:
        return answers.views.node_masks(self.view, self.hits(answers, by_path=by_path).ids)


def run_figures(
    parts: SceneParts,
    out: Path,
    settings: FiguresSettings,
    evaluate: EvaluateSettings,
    *,
    fit: Path | None = None,
    truth: Path | None = None,
    labels: str = "",
    data_root: Path = Path(),
    queries: Sequence[str] = (),
    threads: int = 1,
) -> None:
    """Draw the panel (without ground truth, of `queries`); copy the pose and fit pictures beside it.

    Args:
        fit: report folder of the fit; None copies nothing.
        labels: labels of a published data set instead of `truth`, such as "lerf_ovs/figurines".
    """
    if fit is not None:
        copies = {"registration": parts.scene / "registration.png", "fit": fit / "test_views.png"}
        for name, source in copies.items():
            write_webp(out.with_name(f"{name}.webp"), read_image(source))
    answers = LanguageScene.from_parts(parts, evaluate, threads=threads)
    with stage_log("figures", answers.scene.name) as counts:
        truths = shown_truths(answers.scene, truth, labels, data_root, evaluate)
        rows = annotated_rows(truths, settings) or free_rows(answers, queries, settings)
        save_with_pdf(draw_panel(answers, parts.masks, rows, evaluate), out)
        counts["queries"] = len(rows)


def shown_truths(
    scene: Scene, truth: Path | None, labels: str, data_root: Path, evaluate: EvaluateSettings
) -> Mapping[str, Callable[[], ViewTruth]]:
    """Return the ground-truth regions in a scene's views; empty if it has no annotations or labels."""
    known = open_labelled(labels, data_root) if labels else truth
    return {} if known is None else truths_of(known, scene, evaluate.min_region_px)


def annotated_rows(truths: Mapping[str, Callable[[], ViewTruth]], settings: FiguresSettings) -> list[Shown]:
    """Return texts per level, from large to small regions, each in the annotated views where it is largest.

    Labels without levels form one group.
    """
    by_level: dict[Level | None, dict[str, list[tuple[int, Shown]]]] = {}
    for view, truth_of in truths.items():
        truth = truth_of()
        for query in truth.queries or truth.categories:
            row = Shown(query.text, query.paths[0], query.level, view, query.truth)
            area = int(np.count_nonzero(query.truth))
            by_level.setdefault(query.level, {}).setdefault(query.text, []).append((area, row))
    rows = []
    for level in (*LEVELS, None):
        texts = by_level.get(level, {})
        for places in texts.values():
            places.sort(key=lambda candidate: (-candidate[0], candidate[1].view))
        ordered = sorted(texts, key=lambda text: (-texts[text][0][0], text))
        limit = settings.queries_per_level * (len(LEVELS) if level is None else 1)
        count = min(limit, len(ordered))
        for number in range(count):  # the largest, then evenly spaced down the list
            places = texts[ordered[number * len(ordered) // count]]
            rows += [row for _, row in places[: settings.views]]
    return rows


def free_rows(answers: LanguageScene, queries: Sequence[str], settings: FiguresSettings) -> list[Shown]:
    """Return the given texts, each in the views where its best node is largest."""
    rows = []
    for text in queries:
        hits = answers.query(text, limit=1)
        fallback = [*answers.scene.views("test"), *answers.scene.views("train")]
        views = (list(hits[0].best_views) if hits else []) or fallback
        rows += [Shown(text, path_of(text), None, view, None) for view in views[: settings.views]]
    return rows


def draw_panel(
    answers: LanguageScene, masks_folder: Path, rows: Sequence[Shown], evaluate: EvaluateSettings
) -> Figure:
    """Draw masks in a training view, the field in a held-out view, then one row per query."""
    scene = answers.scene
    masked = next(iter(read_index(masks_folder)["views"]))
    held_out = rows[0].view if rows else (scene.views("test") or scene.views("train"))[0]
    height, width = scene.cameras[held_out].size_hw
    aspect = height / width
    columns = 7 if any(row.truth is not None for row in rows) else 6
    overview_in = 2 * (WIDTH_IN / 4 * aspect + 0.15)
    row_in = WIDTH_IN / columns * aspect + 0.1
    queries_in = len(rows) * row_in + (0.4 if rows else 0)
    figure = Figure(figsize=(WIDTH_IN, overview_in + queries_in + 0.45), layout="constrained")
    label = masks_label(masks_folder)
    warning = " (diagnostic: masks made from the true labels)" if made_from_truth(label) else ""
    title = [scene.name + warning, *textwrap.wrap(answers.caution, TITLE_LETTERS)]
    figure.suptitle("\n".join(title), fontsize=12, fontweight="bold", parse_math=False)
    parts: list[FigureBase] = [figure]
    if rows:
        parts = list(figure.subfigures(2, 1, squeeze=False, height_ratios=[overview_in, queries_in]).flat)
    grid = parts[0].subplots(2, 4, squeeze=False)
    image = answers.views.image(masked)
    masks = HierarchicalMasks.load(Path(masks_folder) / f"{masked}.npz")
    show(grid[0, 0], image, f"photograph {masked} (training view)")
    label_left(grid[0, 0], f"masks: {label}")
    show(grid[1, 0], answers.views.image(held_out), f"photograph {held_out} ({scene.split[held_out]} view)")
    label_left(grid[1, 0], "language field")
    for level in LEVELS:
        count = len(masks.rows_of(level))
        above, below = grid[:, level.index + 1]
        show(above, paint_level(image, masks, level), f"{level.label}: {count} masks")
        show(below, answers.field.image(held_out, level), f"{level.label}: field as colours")
    if rows:
        draw_queries(parts[1], answers, rows, evaluate, columns)
    return figure


def draw_queries(
    figure: FigureBase,
    answers: LanguageScene,
    rows: Sequence[Shown],
    evaluate: EvaluateSettings,
    columns: int,
) -> None:
    """Draw one row per query: ground truth, answers of tree and field, field relevancy at three levels.

    Without an annotated level, the tree and the field each choose their own, as in the protocols. An orange
    frame marks the field's level, a ring its localization point.
    """
    grid = figure.subplots(len(rows), columns, squeeze=False)
    figure.supxlabel("of the field's answer: orange frame: level; white ring: localization point", fontsize=9)
    rule = rule_of(evaluate)
    for axes, row in zip(grid, track(rows, "queries drawn"), strict=True):
        image = answers.views.image(row.view)
        relevancy = np.asarray(answers.field.relevancy(row.path[-1:], row.view))[0]
        hits = row.hits(answers)
        smoothed = SmoothedRelevancy.of(relevancy, rule)
        field_level, field_mask = relevancy_answer(smoothed, row.level, rule)
        points = peaks_of_answer(relevancy, smoothed.filtered, row.level)
        pictures = [("tree", answers.views.node_masks(row.view, hits.ids))]
        if columns == 7:
            pictures.append(("tree, path", row.tree_mask(answers, by_path=True)))
        pictures.append(("field", field_mask))
        show(axes[0], paint_answer(image, None, row.truth), row.title)
        label_left(axes[0], row.text, row.level or hits.level, letters=20)
        for axis, (name, mask) in zip(axes[1:], pictures, strict=False):
            score = row.score(mask)
            show(axis, paint_answer(image, mask, row.truth), f"{name}: {score}" if score else name)
        if len(points):
            axes[len(pictures)].plot(*points[0], "o", **RING)
        low, high = float(relevancy.min()), float(relevancy.max())
        for level in LEVELS:
            top = float(relevancy[level.index].max())
            picture = paint_relevancy(image, relevancy[level.index], low, high)
            title = f"relevancy, {level.label}: {top:.2f}"
            show(axes[columns - 3 + level.index], picture, title, bold=level is field_level)
