"""The picture of a query: answer and relevancy in a few views, and the answer from above."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np
from matplotlib.figure import Figure

from hilsplat.base.levels import LEVELS
from hilsplat.query.hits import counted, doubts_of
from hilsplat.query.language_scene import LanguageScene, path_of
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
    figure.suptitle("\n".join([title, *doubts]), fontsize=12, fontweight="bold", parse_math=False)
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
