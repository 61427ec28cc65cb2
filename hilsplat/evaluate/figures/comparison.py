"""The paper's figures: queries by method, one query over four views, features at three levels."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from matplotlib.figure import Figure

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.progress import stage_log, track
from hilsplat.evaluate.figures.panel import WIDTH_IN, Shown, annotated_rows, free_rows, shown_truths
from hilsplat.evaluate.metrics.relevancy_rule import SmoothedRelevancy, relevancy_mask
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.protocols.views import rule_of
from hilsplat.evaluate.tables.measured import row_name
from hilsplat.query.field_answers import field_colours
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.pictures import label_left, paint_answer, save_with_pdf, show
from hilsplat.query.scene_views import Opened
from hilsplat.scene.finished import FinishedScene
from hilsplat.scene.scene import Scene
from hilsplat.settings import EvaluateSettings, FiguresSettings

MAX_COLUMNS = 8
"""Maximum number of methods drawn as columns in the query figure; if there are more, all become rows."""
VIEWS = 4  # number of views in the one-query figure


@dataclass(frozen=True)
class Answerer:
    """One compared method: the "tree" or "field" of a variant, with its title in tables."""

    title: str
    method: str
    scene: LanguageScene

    def masks(self, rows: Sequence[Shown], evaluate: EvaluateSettings) -> list[Bool[np.ndarray, "H W"]]:
        """Return the answer to each query in its view, at its level if it has one."""
        if self.method == "tree":
            return [query_row.tree_mask(self.scene) for query_row in rows]
        rule, texts_of = rule_of(evaluate), defaultdict[str, list[str]](list)
        for query_row in rows:
            texts_of[query_row.view].append(query_row.path[-1])
        maps = {  # one call for all texts of a view, because each call decodes the view's pixels
            view: dict(zip(texts, np.asarray(self.scene.field.relevancy(texts, view)), strict=True))
            for view, texts in texts_of.items()
        }
        return [
            relevancy_mask(SmoothedRelevancy.of(maps[row.view][row.path[-1]], rule), row.level, rule)
            for row in rows
        ]

    def features(self, view: str) -> list[UInt8[np.ndarray, "H W 3"]]:
        """Return the features at each level as colours; those of a tree are of its nodes."""
        if self.method == "tree":
            return [node_image(self.scene, view, level) for level in LEVELS]
        return [self.scene.field.image(view, level) for level in LEVELS]


@dataclass(frozen=True)
class Column:
    """What the figures show of a method: answers to all queries, to one in several views, and features."""

    title: str
    answers: list[Bool[np.ndarray, "H W"]]
    in_views: list[Bool[np.ndarray, "H W"]]
    features: list[UInt8[np.ndarray, "H W 3"]]


def run_comparison(
    folder: Path,
    variants: Sequence[str],
    names: Mapping[str, str],
    out: Path,
    settings: FiguresSettings,
    evaluate: EvaluateSettings,
    *,
    truth: Path | None = None,
    labels: str = "",
    data_root: Path = Path(),
    queries: Sequence[str] = (),
    threads: int = 1,
) -> None:
    """Draw the three figures of a scene as WebP and PDF; without ground-truth regions, `queries` are shown.

    Args:
        folder: `results/<dataset>/<scene>`, in which every variant is finished.
        variants: variants to compare, each under its own evaluation settings, whose `methods` decide
            whether its tree, its field or both are shown.
        names: variant -> its name in tables.
        out: WebP of the comparison; `views.webp` and `features.webp` are written beside it.
        evaluate: settings for ground-truth regions and for converting maps to masks.
        labels: labels of a published data set instead of `truth`, such as "lerf_ovs/figurines".

    Raises:
        SettingsError: no variant is named.
    """
    if not variants:
        raise SettingsError(
            "there are no variants to compare", expected="at least one", fix="list them in main_variants"
        )
    opened = Opened()  # shared by all variants
    first = open_variant(folder, variants[0], opened, threads)
    scene, image = first.scene, first.views.image
    with stage_log("comparison", scene.name) as counts:
        truths = shown_truths(scene, truth, labels, data_root, evaluate)
        rows = annotated_rows(truths, settings) or free_rows(first, queries, settings)
        del first
        several = over_views(scene, rows, truths)
        view = several[0].view if several else (scene.views("test") or scene.views("train"))[0]
        columns = []
        for variant in track(list(variants), "variants compared"):  # one in memory at a time
            answers = open_variant(folder, variant, opened, threads)
            for method in [name for name in ("tree", "field") if name in answers.settings.methods]:
                one = Answerer(row_name(variant, method, names), method, answers)
                pictures = one.masks(rows, evaluate), one.masks(several, evaluate), one.features(view)
                columns.append(Column(one.title, *pictures))
        save_with_pdf(draw_methods(scene, image, columns, rows), out)
        save_with_pdf(draw_views(scene, image, columns, several), Path(out).with_name("views.webp"))
        save_with_pdf(draw_features(scene, image, columns, view), Path(out).with_name("features.webp"))
        counts |= {"methods": len(columns), "queries": len(rows), "views": len(several)}


def open_variant(folder: Path, variant: str, opened: Opened, threads: int) -> LanguageScene:
    """Open a variant of a scene with its own evaluation settings; files in `opened` are not read again."""
    scene = FinishedScene.locate(folder, variant)
    return LanguageScene.from_parts(scene.parts, scene.evaluate_settings(), threads=threads, opened=opened)


def over_views(
    scene: Scene, rows: Sequence[Shown], truths: Mapping[str, Callable[[], ViewTruth]]
) -> list[Shown]:
    """Return one query in several views: the first part or subpart in `rows`, else the first query.

    Views with ground truth come first, in order, followed by other views, evenly spaced over the scene.
    """
    if not rows:
        return []
    levelled = [row for row in rows if row.level in (Level.PART, Level.SUBPART)]
    chosen = levelled[0] if levelled else rows[0]
    chosen_rows = [chosen]
    for view, truth_of in truths.items():
        if view != chosen.view and len(chosen_rows) < VIEWS:
            known = truth_of()
            for query in known.queries or known.categories:
                if (query.text, query.level) == (chosen.text, chosen.level):
                    chosen_rows.append(Shown(chosen.text, chosen.path, chosen.level, view, query.truth))
    others = scene.views()
    for number in range(VIEWS):
        view = others[number * len(others) // VIEWS]
        if len(chosen_rows) < VIEWS and view not in {row.view for row in chosen_rows}:
            chosen_rows.append(Shown(chosen.text, chosen.path, chosen.level, view, None))
    return chosen_rows


def draw_methods(
    scene: Scene, image: Callable[[str], np.ndarray], columns: Sequence[Column], rows: Sequence[Shown]
) -> Figure:
    """Draw one row per query and one column per method, transposed if there are many methods."""
    many = len(columns) > MAX_COLUMNS
    shape = max(len(rows), 1), len(columns) + 1
    width_in = WIDTH_IN * min(shape[0] / MAX_COLUMNS, 1) if many else WIDTH_IN
    title = f"{scene.name}: queries by method"
    figure, grid = _grid(scene, *(shape[::-1] if many else shape), title, width_in)
    by_query = grid.T if many else grid
    for number, (axes, row) in enumerate(zip(by_query, rows, strict=False)):
        photograph = image(row.view)
        query = f"“{row.text}” ({row.level.label})\n" if many and row.level else ""
        show(axes[0], paint_answer(photograph, None, row.truth), query + row.title)
        if not many:
            label_left(axes[0], row.text, row.level, letters=24)
        for axis, column in zip(axes[1:], columns, strict=True):
            mask = column.answers[number]
            score = row.score(mask)
            named = score if many else f"{column.title}\n{score}".rstrip()
            show(axis, paint_answer(photograph, mask, row.truth), named)
    if many:
        for axes, column in zip(grid[1:, 0], columns, strict=True):
            label_left(axes, column.title)
    return figure


def draw_views(
    scene: Scene, image: Callable[[str], np.ndarray], columns: Sequence[Column], rows: Sequence[Shown]
) -> Figure:
    """Draw one row per method, one column per view, to compare a method's answers across views."""
    query = f"“{rows[0].text}” in {len(rows)} views" if rows else "no query"
    figure, grid = _grid(scene, len(columns) + 1, max(len(rows), 1), f"{scene.name}: {query}")
    for number, row in enumerate(rows):
        photograph = image(row.view)
        show(grid[0][number], paint_answer(photograph, None, row.truth), row.view)
        for position, column in enumerate(columns, start=1):
            mask = column.in_views[number]
            show(grid[position][number], paint_answer(photograph, mask, row.truth), row.score(mask))
    label_left(grid[0][0], "photograph")
    for position, column in enumerate(columns, start=1):
        label_left(grid[position][0], column.title)
    return figure


def draw_features(
    scene: Scene, image: Callable[[str], np.ndarray], columns: Sequence[Column], view: str
) -> Figure:
    """Draw one row per method, one column per level."""
    figure, grid = _grid(scene, len(columns), len(LEVELS) + 1, f"{scene.name}: features at three levels")
    for axes, column in zip(grid, columns, strict=True):
        show(axes[0], image(view), view)
        label_left(axes[0], column.title)
        for level, picture in zip(LEVELS, column.features, strict=True):
            show(axes[level.index + 1], picture, level.label)
    return figure


def node_image(scene: LanguageScene, view: str, level: Level) -> np.ndarray:
    """Colour each pixel by its node's CLIP vector, as `field_colours` colours features."""
    nodes = scene.tree.nodes_of(level)
    colours = np.zeros((len(scene.tree) + 1, 3), np.float32)  # the last row is for Gaussians without a node
    colours[nodes] = field_colours(scene.tree.clip[nodes].astype(np.float32))
    pixels = scene.views.view_weights(view) @ colours[scene.tree.node_of_gaussian[:, level.index]]
    height, width = scene.scene.cameras[view].size_hw
    return (255 * np.clip(pixels, 0, 1)).astype(np.uint8).reshape(height, width, 3)


def _grid(
    scene: Scene, rows: int, columns: int, title: str, width_in: float = WIDTH_IN
) -> tuple[Figure, np.ndarray]:
    """Return an empty grid without ticks, for pictures with the scene's aspect ratio."""
    height, width = scene.cameras[scene.cameras.names[0]].size_hw
    row_in = width_in / columns * height / width + 0.18
    figure = Figure(figsize=(width_in, rows * row_in + 0.4), layout="constrained")
    figure.suptitle(title, fontsize=12, fontweight="bold", parse_math=False)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel():
        axes.set_xticks([])
        axes.set_yticks([])
    return figure, grid
