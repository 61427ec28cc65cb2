"""Ask a finished scene for a text: a ranked list as text, and a picture."""

import re
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np
from matplotlib.figure import Figure

from hilsplat.base.levels import LEVELS
from hilsplat.query.hits import Hit, doubts_of, hits_of
from hilsplat.query.language_scene import PATH_SEPARATOR, LanguageScene, path_of
from hilsplat.query.node_search import NodeHits
from hilsplat.query.pictures import (
    TITLE_LETTERS,
    label_left,
    paint_answer,
    paint_relevancy,
    save_figure,
    show,
    show_from_above,
)
from hilsplat.scene.finished import FinishedScene
from hilsplat.segment.origin import made_from_truth, masks_label
from hilsplat.semantic_tree.export import write_selection_ply

LISTED = 10
"""Most answers to list."""


def answer(
    folder: Path,
    text: str,
    *,
    level: str = "auto",
    variant: str = "default",
    views: int = 3,
    answerer: str = "tree",
    view: str | None = None,
    out: Path | None = None,
    device: str = "cpu",
    threads: int = 1,
) -> str:
    """Ask a scene; write `panel.png` and `selection.ply`, and say what was found.

    Args:
        folder: `results/<dataset>/<scene>`, or a copy of it anywhere.
        text: words, or a path such as "bear > head > nose".
        level: auto, whole, part or subpart.
        variant: named set of settings whose files answer.
        views: number of views in the panel.
        answerer: "tree" or "field", see `LanguageScene.query`.
        view: restricts the answers to what this view shows, and puts it first in the panel; None: the
            whole scene.
        out: folder of both files; by default `queries/<text>` in the scene's folder.
        device: "cpu" or "cuda" for look-ups of the field.
        threads: number of threads for rendering.

    Raises:
        ArtifactError: the scene is not finished.
        SettingsError: the level, answerer, view or device is unknown.
        DeviceError: cuda was asked for and torch finds no device.
    """
    found = FinishedScene.locate(Path(folder), variant)
    settings = found.evaluate_settings()
    scene = LanguageScene.from_parts(found.parts, settings, threads=threads, device=device)
    nodes = scene.find(text, level, answerer=answerer, view=view)
    hits = hits_of(scene, nodes, LISTED)
    panel = (Path(out) if out is not None else found.folder / "queries" / file_name(text)) / "panel.png"
    shown = list(dict.fromkeys([*([view] if view else []), *views_of(scene, hits, views)]))[:views]
    label = masks_label(found.parts.masks)
    note = f"; a diagnostic, masks made from the true labels: {label}" if made_from_truth(label) else ""
    asked = "" if view is None else f", of what {view} shows"
    query_panel(scene, text, nodes, shown, panel, note=asked + note, answerer=answerer)
    selection = panel.with_name("selection.ply")
    write_selection_ply(found.parts.gaussians, scene.gaussians_of(nodes.ids), selection)
    caution = f"\n{scene.caution}" if scene.caution else ""
    return f"{report(scene, text, nodes, view)}{note}{caution}\nwrote {panel} and {selection.name}"


def query_panel(
    scene: LanguageScene,
    text: str,
    hits: NodeHits,
    views: Sequence[str],
    out_png: Path,
    *,
    note: str = "",
    answerer: str = "tree",
) -> None:
    """Draw a query: photograph, answer and relevancy at three levels per view, and the scene from above.

    `note` ends the title; doubts follow below it. With the answerer "field", relevancy is that of the field.
    """
    last = path_of(text)[-1]
    size_hw = scene.scene.cameras[views[0]].size_hw
    width_in, columns = 13.0, 5
    row_in = width_in / columns * size_hw[0] / size_hw[1] + 0.1
    map_in = 4.2
    figure = Figure(figsize=(width_in, len(views) * row_in + map_in + 0.6), layout="constrained")
    found = f"{counted(len(hits.ids), 'node')} at level {hits.level.label}"
    title = f"“{text}” in {scene.scene.name}: {found}{note}"
    doubts = [*wrap(scene.caution, TITLE_LETTERS), *map(str, doubts_of(scene, hits))]
    figure.suptitle("\n".join([title, *doubts]), fontsize=12, fontweight="bold")
    heights = [len(views) * row_in, map_in]
    (upper,), (lower,) = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)
    grid = upper.subplots(len(views), columns, squeeze=False)
    for axes, view in zip(grid, views, strict=True):
        image, mask = scene.image(view), scene.node_masks(view, hits.ids)
        if answerer == "tree":
            relevancy = scene.node_relevancy_map([last], view)[0]
        else:
            relevancy = scene.field_relevancy([last], view, exact=False)[0]
        low, high = float(relevancy.min()), float(relevancy.max())
        show(axes[0], image, view)
        label_left(axes[0], f"{scene.scene.split[view]} view")
        show(axes[1], paint_answer(image, mask), f"answer: {mask.mean():.1%} of the view")
        for each in LEVELS:
            top = float(relevancy[each.index].max())
            picture = paint_relevancy(image, relevancy[each.index], low, high)
            show(
                axes[2 + each.index], picture, f"relevancy, {each.label}: {top:.2f}", bold=each is hits.level
            )
    selected = np.zeros(len(scene.gaussians), np.bool_)
    selected[scene.gaussians_of(hits.ids)] = True
    title = f"from above: {np.count_nonzero(selected)} of {len(selected)} Gaussians; triangles are cameras"
    show_from_above(lower.subplots(), scene.gaussians, scene.scene.cameras, selected, title)
    save_figure(figure, out_png)


def views_of(scene: LanguageScene, hits: Sequence[Hit], count: int) -> list[str]:
    """Views that show the best answers largest, without repeats, then others spread over the scene."""
    best = [view for hit in hits for view in hit.best_views[:1]] + [v for hit in hits for v in hit.best_views]
    every = scene.scene.views()
    spread = [every[number * len(every) // count] for number in range(count)]
    return list(dict.fromkeys([*best, *spread, *every]))[:count]


def report(scene: LanguageScene, text: str, found: NodeHits, view: str | None = None) -> str:
    """The answers as text, with doubts; `view` is the one that the query was restricted to."""
    place = scene.scene.name if view is None else f"what {view} shows of {scene.scene.name}"
    hits, doubts = hits_of(scene, found, LISTED), doubts_of(scene, found)
    if not hits:
        levels = ", ".join(f"--level {each.label}" for each in LEVELS if each is not found.level)
        other = "" if view is None else ", or leave out --view"
        return f"nothing in {place} answers to {text!r} at level {found.level.label}; try {levels}{other}"
    lengths = "metres" if scene.scene.unit == "metre" else "scene units"
    lines = [
        f"{counted(len(hits), 'answer')} to {text!r} in {place}; lengths in {lengths}",
        f"{'node':>5}  {'level':<8} {'score':>5}  {'position':<24} {'box size':<20} best views",
    ]
    for hit in hits:
        position = ", ".join(f"{value:.2f}" for value in hit.centroid)
        size = " x ".join(f"{side:.2f}" for side in hit.oriented_box.size)
        views = ", ".join(hit.best_views)
        lines.append(
            f"{hit.node:>5}  {hit.level.label:<8} {hit.score:>5.2f}  {position:<24} {size:<20} {views}"
        )
    if more := len(found.ids) - len(hits):
        lines.append(f"and {counted(more, 'weaker answer')}, which the pictures show too")
    lines.append('a score of 0.5 is no better than a generic word such as "object"')
    if hits[0].route == "fallback":
        first = path_of(text)[0]
        lines.append(
            f"no answer is part of anything that answers to {first!r}: the whole scene was searched instead"
        )
    return "\n".join([*lines, *(f"doubtful: {doubt}" for doubt in doubts)])


def counted(count: int, noun: str) -> str:
    """A count with its noun: 1 node, 2 nodes."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def file_name(text: str) -> str:
    """Folder name for a query that is safe on every system, such as `bear--nose`."""
    words = [re.sub(r"[^\w.-]+", "-", part).strip("-.") for part in text.split(PATH_SEPARATOR)]
    return "--".join(word for word in words if word) or "query"
