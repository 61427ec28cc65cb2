"""Contact sheet of a synthetic scene: views, labels by level, and the tree with its texts."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int32, UInt8

from hilsplat.base.artifacts import read_index, read_json
from hilsplat.base.atomic import atomic_path
from hilsplat.base.files import list_images
from hilsplat.base.images import read_image
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.ownership import SOFTWARE, require_own_picture
from hilsplat.datasets.hierarchy import AnnotatedNode, HierarchyAnnotations
from hilsplat.segment.pictures import row_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VIEWS_SHOWN = 4
LINES_SHOWN = 52  # maximum number of tree lines in a column, for legibility


def show_panel(
    axes: "Axes", pixels: np.ndarray, title: str, name: str = "", interpolation: str | None = None
) -> None:
    """Show an image in a panel, with an optional title above it and a name in its top left corner."""
    axes.imshow(pixels, interpolation=interpolation)
    axes.set_axis_off()
    axes.set_title(title, fontsize=10, pad=3)
    axes.text(0.02, 0.97, name, color="white", fontsize=8, va="top", transform=axes.transAxes)


def show_world(world_folder: Path, out: Path) -> None:
    """Draw views of a finished world stage with labels by level, and the tree of nodes, as a PNG.

    Each node is marked with the colour of its region; nodes that are not scored in any view are in brackets.

    Raises:
        ArtifactError: if the folder is missing or incomplete.
    """
    from matplotlib.figure import Figure

    truth_folder, images_folder = Path(world_folder) / "truth", Path(world_folder) / "images"
    for folder in (truth_folder, images_folder):
        read_index(folder)
    record = read_json(truth_folder / "scene.json")
    truth = HierarchyAnnotations.load(truth_folder)
    images = list_images(images_folder)
    picked = [images[i] for i in np.linspace(0, len(images) - 1, min(VIEWS_SHOWN, len(images))).astype(int)]
    colours = row_colours(len(truth.nodes))
    scored = {node for ids in truth.views.values() for node in ids}
    lines = tree_lines(truth.nodes)
    columns = -(-len(lines) // LINES_SHOWN)
    figure = Figure(figsize=(10.5 + 2.6 * columns, 2.7 * len(picked) + 0.6), dpi=110)
    widths = [1] * 4 + [0.95] * columns
    top = 1 - 0.55 / (2.7 * len(picked) + 0.6)
    margins = {"left": 0.01, "right": 0.99, "bottom": 0.01, "top": top, "wspace": 0.03, "hspace": 0.04}
    grid = figure.add_gridspec(len(picked), 4 + columns, width_ratios=widths, **margins)
    for row, image in enumerate(picked):
        panels = [("view", read_image(image))]
        panels += [(level.label, _panel(truth, image.name, level, colours)) for level in LEVELS]
        for column, (title, pixels) in enumerate(panels):
            axes = figure.add_subplot(grid[row, column])
            show_panel(axes, pixels, "" if row else title, "" if column else image.name, "nearest")
    per_column = -(-len(lines) // columns)
    for column in range(columns):
        axes = figure.add_subplot(grid[:, 4 + column])
        axes.set_axis_off()
        axes.set(xlim=(0, 1), ylim=(per_column, 0))
        for row, (depth, node) in enumerate(lines[column * per_column : (column + 1) * per_column]):
            text = node.text if node.id in scored else f"[{node.text}]"
            y, x = row + 0.5, 0.06 + 0.09 * depth
            axes.plot(x - 0.025, y, "s", color=colours[node.id] / 255, markersize=6)
            axes.text(x, y, text, fontsize=9, va="center", weight="bold" if depth == 0 else "normal")
    figure.suptitle(
        f"{record['source']} (generator {record['generator_version']}, {record['split']} seed): "
        f"{record['objects_placed']} of {record['objects_asked']} objects placed, {len(images)} views",
        fontsize=11,
    )
    require_own_picture(out)
    with atomic_path(out) as temporary:
        figure.savefig(temporary, format="png", metadata=SOFTWARE)


def _panel(
    truth: HierarchyAnnotations, view: str, level: Level, colours: UInt8[np.ndarray, "N 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Return a level's labels as colours, and the whole in dark grey where the level has no node."""
    labels = truth.label_image(view, level)
    panel = coloured(labels, colours)
    whole = coloured(truth.label_image(view, Level.WHOLE), colours).mean(axis=-1, keepdims=True)
    return np.where(labels[..., None] >= 0, panel, (0.28 * whole).astype(np.uint8))


def coloured(
    labels: Int32[np.ndarray, "H W"], colours: UInt8[np.ndarray, "N 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Return a label image as colours, black where there is no node."""
    table = np.concatenate([colours, np.zeros((1, 3), np.uint8)])  # row -1 is black
    return table[labels]


def tree_lines(nodes: tuple[AnnotatedNode, ...]) -> list[tuple[int, AnnotatedNode]]:
    """Return nodes and their depths in depth-first order; siblings with the same text are listed once."""
    children: dict[int, list[AnnotatedNode]] = {}
    for node in nodes:
        children.setdefault(node.parent, []).append(node)
    lines: list[tuple[int, AnnotatedNode]] = []

    def walk(parent: int, depth: int) -> None:
        first: dict[str, AnnotatedNode] = {}
        for node in children.get(parent, []):
            first.setdefault(node.text, node)
        for node in first.values():
            lines.append((depth, node))
            walk(node.id, depth + 1)

    walk(NONE, 0)
    return lines
