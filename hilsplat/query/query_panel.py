"""Picture of a query: the answer and the relevancy in a few views, and the answer from above."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.transforms import IdentityTransform

from hilsplat.base.levels import LEVELS, path_of
from hilsplat.base.tables import counted
from hilsplat.query.hits import doubts_of
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.node_search import NodeHits
from hilsplat.query.pictures import (
    DPI,
    TITLE_LETTERS,
    paint_answer,
    paint_relevancy,
    save_figure,
    show_from_above,
)

COLUMNS = 5
CELL_PX = 272
GAP_PX = 8
LEFT_PX = 24
TITLE_PX = 20
HEADING_PX = 26
MAP_PX = 460
NAMED = 3  # maximum number of answer names in the title


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
    """Draw each view's photograph, answer and relevancy at three levels, and the scene from above.

    `note` is appended to the title, and doubts are written below. The relevancy is that of `answerer`.
    """
    last = path_of(text)[-1]
    count = f"{counted(len(hits.ids), 'node')} at level {hits.level.label}"
    names = list(dict.fromkeys(scene.name_of(int(node)) or "?" for node in hits.ids))
    called = f" ({', '.join([*names[:NAMED], *(['…'] if names[NAMED:] else [])])})" if names else ""
    title = f"“{text}” in {scene.scene.name}: {count}{called}{note}"
    texts = [title, scene.caution_about(text), *map(str, doubts_of(hits))]
    heading = [line for query_text in texts for line in wrap(query_text, TITLE_LETTERS)]
    height, width = scene.scene.cameras[views[0]].size_hw
    row_px = TITLE_PX + round(CELL_PX * height / width) + GAP_PX
    upper_px = HEADING_PX * len(heading) + GAP_PX + len(views) * row_px
    page = _Page(LEFT_PX + COLUMNS * (CELL_PX + GAP_PX), upper_px + MAP_PX)
    for number, line in enumerate(heading):
        page.write(line, page.width_px / 2, (number + 0.5) * HEADING_PX, size=12.0, bold=True)
    for row, view in enumerate(views):
        top = upper_px - (len(views) - row) * row_px
        image, mask = scene.views.image(view), scene.views.node_masks(view, hits.ids)
        if answerer == "tree":
            relevancy = scene.node_relevancy_map([last], view)[0]
        else:
            relevancy = scene.field.relevancy([last], view)[0]
        low, high = float(relevancy.min()), float(relevancy.max())
        pictures = [(image, view), (paint_answer(image, mask), f"answer: {mask.mean():.1%} of the view")]
        for level in LEVELS:
            at_level = relevancy[level.index]
            name = f"relevancy, {level.label}: {float(at_level.max()):.2f}"
            pictures.append((paint_relevancy(image, at_level, low, high), name))
        page.write(f"{scene.scene.split[view]} view", LEFT_PX / 2, top + row_px / 2, rotation=90.0)
        for column, (picture, name) in enumerate(pictures):
            bold = column == 2 + hits.level.index
            page.show(picture, name, LEFT_PX + column * (CELL_PX + GAP_PX), top, row_px, bold)
    selected = np.zeros(len(scene.gaussians), np.bool_)
    selected[scene.views.gaussians_of(hits.ids)] = True
    title = f"from above: {np.count_nonzero(selected)} of {len(selected)} Gaussians; triangles are cameras"
    below = (MAP_PX - TITLE_PX - GAP_PX) / page.height_px
    axes = page.figure.add_axes((0.02, GAP_PX / page.height_px, 0.96, below))
    show_from_above(axes, scene.gaussians, scene.scene.cameras, selected, title)
    save_figure(page.figure, out_png)


class _Page:
    """A figure with pixel coordinates, measured from its upper left corner.

    Pictures are scaled and placed directly. One `Axes` per picture, with a layout computed by drawing
    everything twice, would take most of a query's time.
    """

    def __init__(self, width_px: int, height_px: int) -> None:
        self.width_px, self.height_px = width_px, height_px
        self.figure = Figure(figsize=(width_px / DPI, height_px / DPI), dpi=DPI)

    def write(
        self, text: str, x: float, y: float, *, size: float = 8.0, bold: bool = False, rotation: float = 0.0
    ) -> None:
        """Write text centred at (x, y)."""
        at, weight = (x / self.width_px, 1 - y / self.height_px), "bold" if bold else "normal"
        written = self.figure.text(*at, text, ha="center", va="center", parse_math=False)
        written.set(size=size, weight=weight, rotation=rotation)

    def show(
        self, picture: UInt8[np.ndarray, "H W 3"], title: str, left: int, top: int, row_px: int, bold: bool
    ) -> None:
        """Draw a picture below its title, as large as its cell allows."""
        import cv2

        height, width = picture.shape[:2]
        scale = min(CELL_PX / width, (row_px - TITLE_PX - GAP_PX) / height)
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        scaled = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
        x, y = left + (CELL_PX - size[0]) // 2, self.height_px - top - TITLE_PX - size[1]
        self.figure.figimage(scaled, x, y)
        line, colour = (2.0, "#ff7a00") if bold else (0.5, "#888888")
        frame = Rectangle((x, y), *size, fill=False, lw=line, ec=colour, transform=IdentityTransform())
        self.figure.add_artist(frame)
        self.write(title, left + CELL_PX / 2, top + TITLE_PX / 2, bold=bold)
