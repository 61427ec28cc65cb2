"""Pictures of the synthetic world for its manual: one of each class, and some scenes with labels."""

import logging
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int32

from hilsplat.base.artifacts import atomic_path
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.provenance import SOFTWARE, require_own_picture
from hilsplat.scene.cameras import Camera
from hilsplat.world.objects.builder import ObjectModel
from hilsplat.world.objects.catalogue import TABLETOP, build_object
from hilsplat.world.paints import Paint
from hilsplat.world.render import label_view, render_view
from hilsplat.world.scenes.kinds import build_scene, scene_cameras
from hilsplat.world.scenes.scene import Assembly, Style, WorldScene, footprint_of
from hilsplat.world.shapes import box
from hilsplat.world.sheet import coloured, node_colours
from hilsplat.world.views import looking_at, on_sphere, pinhole

if TYPE_CHECKING:
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
"""Radius to which an object is scaled in its picture; tall objects are scaled by their height."""

_GROUND = Paint(
    "grey", "mottled", (0.66, 0.66, 0.64), (0.63, 0.63, 0.61), 3.0, 0.0, 10.0, 0.1, (5.0, 6.0, 7.0)
)


def draw_classes(out: Path, names: Sequence[str] = TABLETOP, seed: int = 0) -> None:
    """Write a PNG that shows one object of each named tabletop class with its name."""
    from matplotlib.figure import Figure

    rows = -(-len(names) // CLASS_COLUMNS)
    figure = Figure(figsize=(1.5 * CLASS_COLUMNS, 1.68 * rows), dpi=100)
    for index, name in enumerate(names):
        logger.info("draw %s", name)
        scene, camera = _alone(build_object(name, np.random.default_rng(seed)))
        axes = figure.add_subplot(rows, CLASS_COLUMNS, index + 1)
        axes.imshow(render_view(scene, camera, 3))
        axes.set_axis_off()
        axes.set_title(name, fontsize=10, pad=3)
    figure.subplots_adjust(left=0.005, right=0.995, bottom=0.005, top=0.965, wspace=0.03, hspace=0.17)
    _write(figure, out)


def _alone(model: ObjectModel) -> tuple[WorldScene, Camera]:
    """Return a scene with one object on plain ground, and a camera whose view the object fills."""
    centre, radius = footprint_of(model.triangles)
    height = float(model.triangles[..., 2].max())
    scale = min(RADIUS / radius, 2.7 * RADIUS / height)
    assembly = Assembly()
    assembly.add_object(model, scale, -centre * scale, 0.0)
    assembly.add_surroundings("ground", (), [(box((8, 8, 0.1), (0, 0, -0.05)), _GROUND)])
    style = Style(light_position=(1.2, -1.0, 3.6), exposure=1.3)
    scene = assembly.finished(model.name, 0, 1, (), style)
    middle = np.array([0, 0, 0.48 * height * scale])
    pose = looking_at(middle + on_sphere(AZIMUTH_DEG, ELEVATION_DEG, 1.9), middle)
    reach = max(0.90 * RADIUS, 0.60 * height * scale)
    fov_deg = 2 * float(np.degrees(np.arctan(reach / 1.75)))
    return scene, Camera("class.png", pose, pinhole(CLASS_PX, fov_deg), (CLASS_PX, CLASS_PX))


def draw_scenes(kind: str, seeds: Sequence[int], out: Path) -> None:
    """Write a PNG of some scenes of a kind: a view of each, and its true labels by level.

    Raises:
        SceneError: if the kind is unknown.
    """
    from matplotlib.figure import Figure

    across = 2  # scenes side by side, each with four panels
    rows = -(-len(seeds) // across)
    figure = Figure(figsize=(PANEL_INCHES * 4 * across, PANEL_INCHES * rows + 0.25), dpi=100)
    titles = ["", *(level.label for level in LEVELS)]
    for index, seed in enumerate(seeds):
        logger.info("draw %s:%d", kind, seed)
        scene = build_scene(kind, seed, OBJECTS)
        cameras = scene_cameras(scene, 40, SCENE_PX, 360)
        camera = cameras[cameras.names[(17 + 6 * index) % len(cameras)]]
        labels, colours = label_view(scene, camera), node_colours(len(scene.nodes))
        for shade, node in enumerate(sorted(scene.background)):
            colours[node] = 60 + 18 * shade  # greys: never scored
        panels = [render_view(scene, camera, 3)]
        panels += [coloured(_filled(labels, level), colours) for level in LEVELS]
        for column, (title, panel) in enumerate(zip(titles, panels, strict=True)):
            axes = figure.add_subplot(rows, 4 * across, index * 4 + column + 1)
            axes.imshow(panel, interpolation="nearest" if column else None)
            axes.set_axis_off()
            if index < across:
                axes.set_title(title or "view", fontsize=10, pad=3)
            if column == 0:
                name = f"{kind} {seed}"
                axes.text(0.03, 0.97, name, color="white", fontsize=7.5, va="top", transform=axes.transAxes)
    top = 1 - 0.24 / (PANEL_INCHES * rows + 0.25)
    figure.subplots_adjust(left=0.003, right=0.997, bottom=0.005, top=top, wspace=0.025, hspace=0.03)
    _write(figure, out)


def _filled(labels: Int32[np.ndarray, "3 H W"], level: Level) -> Int32[np.ndarray, "H W"]:
    """Return the node per pixel at a level, or that of the next coarser level with a node."""
    image = labels[0]
    for finer in range(1, level.index + 1):
        image = np.where(labels[finer] >= 0, labels[finer], image)
    return image


def _write(figure: "Figure", out: Path) -> None:
    """Write a figure as PNG with a dithered palette of 256 colours, which halves the file size."""
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
