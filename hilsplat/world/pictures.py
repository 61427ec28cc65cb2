"""Pictures of the synthetic world: one object per class, scenes with labels, and contact sheets."""

import logging
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int32, UInt8

from hilsplat.base.artifacts import atomic_path, read_index, read_json
from hilsplat.base.files import list_images
from hilsplat.base.images import read_image
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.provenance import SOFTWARE, require_own_picture
from hilsplat.datasets.synthetic.hierarchy import AnnotatedNode, HierarchyAnnotations
from hilsplat.scene.cameras import Camera
from hilsplat.world.objects.builder import ObjectModel
from hilsplat.world.objects.catalogue import TABLETOP, build_object
from hilsplat.world.paints import Paint
from hilsplat.world.render import label_view, render_view
from hilsplat.world.scenes.kinds import build_scene, scene_cameras
from hilsplat.world.scenes.scene import Assembly, Style, WorldScene, footprint_of
from hilsplat.world.shapes import box
from hilsplat.world.views import on_sphere, square_camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

logger = logging.getLogger(__name__)

CLASS_PX = 150
CLASS_COLUMNS = 9
SCENE_PX = 256
PANEL_INCHES = 1.95
OBJECTS = 7
AZIMUTH_DEG = 25.0
ELEVATION_DEG = 30.0
RADIUS = 0.36
"""Radius to which an object is scaled in its picture; tall objects are scaled by height."""

VIEWS_SHOWN = 4
LINES_SHOWN = 52
"""Maximum number of tree lines in a column, for legibility."""

_GREYS = ((0.66, 0.66, 0.64), (0.63, 0.63, 0.61))
_GROUND = Paint("grey", "mottled", *_GREYS, 3.0, 0.0, 10.0, 0.1, (5.0, 6.0, 7.0))


def draw_classes(out: Path, names: Sequence[str] = TABLETOP) -> None:
    """Draw one object of each named tabletop class as a PNG."""
    from matplotlib.figure import Figure

    rows = -(-len(names) // CLASS_COLUMNS)
    figure = Figure(figsize=(1.5 * CLASS_COLUMNS, 1.68 * rows), dpi=100)
    for index, name in enumerate(names):
        logger.info("draw %s", name)
        scene, camera = _alone(build_object("tabletop", name, np.random.default_rng(0)))
        _show(figure.add_subplot(rows, CLASS_COLUMNS, index + 1), render_view(scene, camera, 3), name)
    figure.subplots_adjust(left=0.005, right=0.995, bottom=0.005, top=0.965, wspace=0.03, hspace=0.17)
    _write(figure, out)


def _alone(model: ObjectModel) -> tuple[WorldScene, Camera]:
    """Return a scene with one object on plain ground, and a camera whose view the object fills."""
    centre, radius = footprint_of(model.triangles)
    height = float(model.triangles[..., 2].max())
    scale = min(RADIUS / radius, 2.7 * RADIUS / height)
    assembly = Assembly(model.name, 0)
    assembly.add_object(model, scale, -centre * scale, 0.0)
    assembly.add_surroundings("ground", (), [(box((8, 8, 0.1), (0, 0, -0.05)), _GROUND)])
    style = Style(light_position=(1.2, -1.0, 3.6), exposure=1.3)
    scene = assembly.finished(1, (), style)
    middle = np.array([0, 0, 0.48 * height * scale])
    sight = middle + on_sphere(AZIMUTH_DEG, ELEVATION_DEG, 1.9), middle
    reach = max(0.90 * RADIUS, 0.60 * height * scale)
    fov_deg = 2 * float(np.degrees(np.arctan(reach / 1.75)))
    return scene, square_camera("class.png", sight, CLASS_PX, fov_deg)


def draw_scenes(kind: str, seeds: Sequence[int], out: Path) -> None:
    """Draw one view per scene with its ground-truth labels by level, as a PNG.

    Raises:
        SceneError: if the kind is unknown.
    """
    from matplotlib.figure import Figure

    across = 2  # scenes side by side, each with four panels
    rows = -(-len(seeds) // across)
    figure = Figure(figsize=(PANEL_INCHES * 4 * across, PANEL_INCHES * rows + 0.25), dpi=100)
    titles = ["view", *(level.label for level in LEVELS)]
    for index, seed in enumerate(seeds):
        logger.info("draw %s:%d", kind, seed)
        scene = build_scene(kind, seed, OBJECTS)
        cameras = scene_cameras(scene, 40, SCENE_PX, 360)
        camera = cameras[cameras.names[(17 + 6 * index) % len(cameras)]]
        labels, colours = label_view(scene, camera), node_colours(len(scene.nodes))
        for shade, node in enumerate(sorted(scene.background)):
            colours[node] = 60 + 18 * shade  # grey, because the background is never scored
        panels = [render_view(scene, camera, 3)]
        nearest = labels[0]  # the node at the level, or at the next coarser level that has one
        for level in LEVELS:
            nearest = np.where(labels[level.index] >= 0, labels[level.index], nearest)
            panels.append(coloured(nearest, colours))
        for column, (title, panel) in enumerate(zip(titles, panels, strict=True)):
            axes = figure.add_subplot(rows, 4 * across, index * 4 + column + 1)
            name, interpolation = ("", "nearest") if column else (f"{kind} {seed}", None)
            _show(axes, panel, title if index < across else "", name, interpolation)
    top = 1 - 0.24 / (PANEL_INCHES * rows + 0.25)
    figure.subplots_adjust(left=0.003, right=0.997, bottom=0.005, top=top, wspace=0.025, hspace=0.03)
    _write(figure, out)


def _show(
    axes: "Axes", pixels: np.ndarray, title: str, name: str = "", interpolation: str | None = None
) -> None:
    """Show an image in a panel, with an optional title above it and a name in its top left corner."""
    axes.imshow(pixels, interpolation=interpolation)
    axes.set_axis_off()
    axes.set_title(title, fontsize=10, pad=3)
    axes.text(0.02, 0.97, name, color="white", fontsize=8, va="top", transform=axes.transAxes)


def _write(figure: "Figure", out: Path) -> None:
    """Write a figure as a PNG with a dithered palette of 256 colours, which halves the file size."""
    from PIL import Image, PngImagePlugin

    full = BytesIO()
    figure.savefig(full, format="png")
    with Image.open(full) as picture:
        pixels = picture.convert("RGB")
    palette = pixels.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=1)
    reduced = pixels.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
    own = PngImagePlugin.PngInfo()
    for key, value in SOFTWARE.items():
        own.add_text(key, value)
    require_own_picture(out)
    with atomic_path(out) as temporary:
        reduced.save(temporary, format="PNG", optimize=True, pnginfo=own)


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
            _show(axes, pixels, "" if row else title, "" if column else image.name, "nearest")
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
    """Return a level's labels as colours, and the whole in dark grey where the level has no node."""
    labels = truth.label_image(view, level)
    panel = coloured(labels, colours)
    whole = coloured(truth.label_image(view, Level.WHOLE), colours).mean(axis=-1, keepdims=True)
    return np.where(labels[..., None] >= 0, panel, (0.28 * whole).astype(np.uint8))


def node_colours(count: int) -> UInt8[np.ndarray, "N 3"]:
    """Return a colour per node; consecutive nodes have very different hues (golden-ratio steps)."""
    from matplotlib.colors import hsv_to_rgb

    row = np.arange(count)
    hsv = ((0.13 + 0.618034 * row) % 1, 0.55 + 0.35 * (row // 2 % 2), 0.70 + 0.30 * (row // 3 % 2))
    return (255 * hsv_to_rgb(np.stack(hsv, axis=1))).astype(np.uint8)


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
