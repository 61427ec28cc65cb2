"""Contact sheet of a synthetic scene: views, their true labels by level, and the tree of texts."""

from pathlib import Path

import numpy as np
from jaxtyping import Int32, UInt8

from hilsplat.base.artifacts import atomic_path, read_index, read_json
from hilsplat.base.files import list_images
from hilsplat.base.images import read_image
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.provenance import SOFTWARE, require_own_picture
from hilsplat.datasets.synthetic.hierarchy import AnnotatedNode, HierarchyAnnotations

VIEWS_SHOWN = 4
LINES_SHOWN = 52
"""Maximum number of tree lines in a column, for legibility."""


def show_world(world_folder: Path, out: Path) -> None:
    """Draw some views of a finished world stage with their labels by level, and the tree of texts, as PNG.

    Each text is marked in the colour of its region; texts that no view annotates are in brackets.

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
    colours = node_colours(len(truth.nodes))
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
            axes.imshow(pixels, interpolation="nearest")
            axes.set_axis_off()
            if row == 0:
                axes.set_title(title, fontsize=10)
            if column == 0:
                axes.text(
                    0.02, 0.97, image.name, color="white", fontsize=8, va="top", transform=axes.transAxes
                )
    per_column = -(-len(lines) // columns)
    for column in range(columns):
        axes = figure.add_subplot(grid[:, 4 + column])
        axes.set_axis_off()
        axes.set(xlim=(0, 1), ylim=(per_column, 0))
        for row, (depth, node) in enumerate(lines[column * per_column : (column + 1) * per_column]):
            shown = node.text if node.id in scored else f"[{node.text}]"
            y, x = row + 0.5, 0.06 + 0.09 * depth
            axes.plot(x - 0.025, y, "s", color=colours[node.id] / 255, markersize=6)
            axes.text(x, y, shown, fontsize=9, va="center", weight="bold" if depth == 0 else "normal")
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
    """Return the labels of a level as colours, with the whole in dark grey where the level has no node."""
    labels = truth.label_image(view, level)
    panel = coloured(labels, colours)
    whole = coloured(truth.label_image(view, Level.WHOLE), colours).mean(axis=-1, keepdims=True)
    return np.where(labels[..., None] >= 0, panel, (0.28 * whole).astype(np.uint8))


def node_colours(count: int) -> UInt8[np.ndarray, "N 3"]:
    """Return a colour per node; consecutive nodes have very different hues (golden-ratio steps)."""
    hue = (0.13 + 0.618034 * np.arange(count)) % 1
    value = 0.70 + 0.30 * ((np.arange(count) // 3) % 2)
    saturation = 0.55 + 0.35 * ((np.arange(count) // 2) % 2)
    channel = (hue[:, None] * 6 + np.array([5.0, 3.0, 1.0])) % 6
    ramp = np.clip(np.minimum(channel, 4 - channel), 0, 1)
    return (255 * value[:, None] * (1 - saturation[:, None] * ramp)).astype(np.uint8)


def coloured(
    labels: Int32[np.ndarray, "H W"], colours: UInt8[np.ndarray, "N 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Return a label image as colours, black where there is no node."""
    table = np.concatenate([colours, np.zeros((1, 3), np.uint8)])  # row -1 is black
    return table[labels]


def tree_lines(nodes: tuple[AnnotatedNode, ...]) -> list[tuple[int, AnnotatedNode]]:
    """Return nodes with their depth, depth first; siblings with the same text are listed once."""
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
