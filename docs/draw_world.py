"""Draw the pictures of docs/world.md.

python docs/draw_world.py classes classes.png                  # one object of each tabletop class
python docs/draw_world.py tabletop scenes.png 100 101 102      # one view of each scene, with its labels
"""

import argparse
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from hilsplat.base.levels import LEVELS
from hilsplat.scene.cameras import Camera
from hilsplat.segment.pictures import row_colours
from hilsplat_world.objects.builder import ObjectModel
from hilsplat_world.objects.catalogue import TABLETOP, build_object
from hilsplat_world.paints import Paint
from hilsplat_world.pictures import coloured, show_panel
from hilsplat_world.render import label_view, render_view
from hilsplat_world.scenes.kinds import KINDS, build_scene, scene_cameras
from hilsplat_world.scenes.scene import Assembly, Style, WorldScene, footprint_of
from hilsplat_world.shapes import box
from hilsplat_world.views import on_sphere, square_camera

CLASS_PX = 150
CLASS_COLUMNS = 9
SCENE_PX = 256
PANEL_INCHES = 1.95
OBJECTS = 7
AZIMUTH_DEG = 25.0
ELEVATION_DEG = 30.0
RADIUS = 0.36
"""Radius to which an object is scaled in its picture; tall objects are scaled by height."""

_GREYS = ((0.66, 0.66, 0.64), (0.63, 0.63, 0.61))
_GROUND = Paint("grey", "mottled", *_GREYS, 3.0, 0.0, 10.0, 0.1, (5.0, 6.0, 7.0))


def draw_classes(out: Path, names: Sequence[str] = TABLETOP) -> None:
    """Draw one object of each named tabletop class as a PNG."""
    rows = -(-len(names) // CLASS_COLUMNS)
    figure = Figure(figsize=(1.5 * CLASS_COLUMNS, 1.68 * rows), dpi=100)
    for index, name in enumerate(names):
        scene, camera = _alone(build_object("tabletop", name, np.random.default_rng(0)))
        show_panel(figure.add_subplot(rows, CLASS_COLUMNS, index + 1), render_view(scene, camera, 3), name)
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
    return scene, square_camera(sight, CLASS_PX, fov_deg)


def draw_scenes(kind: str, seeds: Sequence[int], out: Path) -> None:
    """Draw one view per scene with its ground-truth labels by level, as a PNG."""
    across = 2  # scenes side by side, each with four panels
    rows = -(-len(seeds) // across)
    figure = Figure(figsize=(PANEL_INCHES * 4 * across, PANEL_INCHES * rows + 0.25), dpi=100)
    titles = ["view", *(level.label for level in LEVELS)]
    for index, seed in enumerate(seeds):
        scene = build_scene(kind, seed, OBJECTS)
        cameras = scene_cameras(scene, 40, SCENE_PX, 360)
        camera = cameras[cameras.names[(17 + 6 * index) % len(cameras)]]
        labels, colours = label_view(scene, camera), row_colours(len(scene.nodes))
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
            show_panel(axes, panel, title if index < across else "", name, interpolation)
    top = 1 - 0.24 / (PANEL_INCHES * rows + 0.25)
    figure.subplots_adjust(left=0.003, right=0.997, bottom=0.005, top=top, wspace=0.025, hspace=0.03)
    _write(figure, out)


def _write(figure: Figure, out: Path) -> None:
    """Write a figure as a PNG with a dithered palette of 256 colours, which halves the file size."""
    full = BytesIO()
    figure.savefig(full, format="png")
    with Image.open(full) as picture:
        pixels = picture.convert("RGB")
    palette = pixels.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=1)
    reduced = pixels.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
    reduced.save(out, format="PNG", optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("classes", *KINDS), help="classes, or a kind of scene")
    parser.add_argument("out", type=Path, help="PNG to write")
    parser.add_argument("seeds", type=int, nargs="*", help="seeds of the scenes")
    options = parser.parse_args()
    if options.what == "classes":
        draw_classes(options.out)
    elif not options.seeds:
        parser.error("scenes need seeds, such as 100 101")
    else:
        draw_scenes(options.what, options.seeds, options.out)
