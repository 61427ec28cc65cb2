"""Tabletop scenes: objects on a round table in a room (stand-ins for LERF, 3D-OVS, Hi-LERF, Hi-3DOVS)."""

import logging
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hilsplat_world.objects.builder import CORNERS
from hilsplat_world.objects.catalogue import TABLETOP, build_object
from hilsplat_world.paints import Paint, PaintBox
from hilsplat_world.scenes.scene import Assembly, PlacedObject, Style, WorldScene, footprint_of
from hilsplat_world.shapes import Mesh, box, cylinder, loft, rotation_about
from hilsplat_world.views import Sight, arc_azimuths, on_sphere

logger = logging.getLogger(__name__)

TABLE_RADIUS = 0.9
ROOM_HALF = 3.0
FLOOR_Z = -0.75
WALL_HEIGHT = 3.4
COVERED_SHARE = 0.58  # share of the table top that the objects' footprints cover if all objects are placed
MAX_FOOTPRINT = 0.36
MAX_HEIGHT_TO_FOOTPRINT = 2.7
GAP = 0.015
WALL_GROUPS = ("brick", "collage", "stone", "plain", "cloth")
ROOM_PALE = 0.5  # share of grey mixed into walls and floor, so that the objects stand out
FOV_DEG = 50.0
ELEVATIONS_DEG = (24.0, 46.0)
DISTANCE = 2.15 * TABLE_RADIUS
LOOK_AT_Z = 0.16
TRIES = 150
LAYOUTS = 25
"""Maximum number of layouts tried; the first layout that fits all objects is used, or else the fullest."""


def build_tabletop(seed: int, objects: int) -> WorldScene:
    """Build a scene of objects on a table whose top is at z = 0.

    The more objects are requested, the smaller they are. No class repeats before all have been used. Objects
    are placed at random without overlapping footprints; objects that do not fit are omitted.
    """
    rng = np.random.default_rng([seed, 1])
    assembly = Assembly("tabletop", seed)
    order = np.concatenate([rng.permutation(len(TABLETOP)) for _ in range(1 + objects // len(TABLETOP))])
    typical = min(MAX_FOOTPRINT, TABLE_RADIUS * float(np.sqrt(COVERED_SHARE / objects)))
    drawn = []
    for i in range(objects):
        model = build_object("tabletop", TABLETOP[order[i]], np.random.default_rng([seed, 2, i]))
        centre, radius = footprint_of(model.triangles)
        height = float(model.triangles[..., 2].max())
        size = typical * float(rng.uniform(0.92, 1.08))
        scale = min(size / radius, MAX_HEIGHT_TO_FOOTPRINT * size / height)
        drawn.append((model, centre * scale, radius * scale, height * scale, scale))
    drawn.sort(key=lambda entry: -entry[2])
    spots = _layout(rng, [entry[2] for entry in drawn])
    placed: list[PlacedObject] = []
    for (model, centre, radius, height, scale), spot in zip(drawn, spots, strict=True):
        if spot is None:
            logger.warning("scene tabletop:%d: no space left for the %s", seed, model.name)
            continue
        yaw = float(rng.uniform(-110, 110))
        xy = spot - rotation_about("z", yaw)[:2, :2] @ centre
        node = assembly.add_object(model, scale, xy, yaw)
        placed.append(PlacedObject(model.name, node, (float(spot[0]), float(spot[1])), radius, height, yaw))
    logger.info("scene tabletop:%d: %d of %d objects placed", seed, len(placed), objects)
    _add_room(assembly, np.random.default_rng([seed, 3]))
    return assembly.finished(objects, placed, _lamplight(np.random.default_rng([seed, 4])))


def _layout(rng: np.random.Generator, radii: list[float]) -> list[Float[np.ndarray, " 2"] | None]:
    """Return random places on the table for footprints, given largest first; None for omitted objects.

    Each place is redrawn, at most `TRIES` times, until its footprint overlaps no earlier footprint.
    """
    fullest: list[np.ndarray | None] = []
    most = -1
    for _ in range(LAYOUTS):
        spots: list[np.ndarray | None] = []
        taken: list[tuple[np.ndarray, float]] = []
        for radius in radii:
            reach = TABLE_RADIUS - 0.6 * radius  # objects may overhang the edge slightly, as in reality
            spots.append(None)
            for _ in range(TRIES):
                angle, away = rng.uniform(0, 2 * np.pi), reach * np.sqrt(rng.uniform())
                spot = np.array([away * np.cos(angle), away * np.sin(angle)])
                if all(np.hypot(*(spot - other)) >= radius + size + GAP for other, size in taken):
                    taken.append((spot, radius))
                    spots[-1] = spot
                    break
        if len(taken) > most:
            fullest, most = spots, len(taken)
        if most == len(radii):
            break
    return fullest


def _add_room(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a richly textured table, floor and walls, and sometimes a cloth, a rug or pictures."""
    paints = PaintBox(rng)
    _add_table(assembly, rng, paints)
    floor = paints.draw(str(rng.choice(["wood", "collage", "stone", "tiles"])), scale=0.35).paled(ROOM_PALE)
    ground = box((2 * ROOM_HALF, 2 * ROOM_HALF, 0.1), (0, 0, FLOOR_Z - 0.05))
    assembly.add_surroundings("floor", ("ground", f"{floor.colour} floor"), [(ground, floor)])
    if rng.random() < 0.5:
        woven = _fabric(paints, 0.35).paled(0.35)
        mesh = cylinder(1.0, FLOOR_Z, FLOOR_Z + 0.02, 48)
        mesh = mesh.scaled(rng.uniform(1.3, 1.8), rng.uniform(1.3, 1.8), 1)
        if rng.random() < 0.5:
            mesh = box((2.9, rng.uniform(2.2, 2.9), 0.03), (0, 0, FLOOR_Z + 0.01))
        mesh = mesh.turned("z", float(rng.uniform(0, 180)))
        assembly.add_surroundings("rug", ("carpet", f"{woven.colour} rug"), [(mesh, woven)])
    walls, pictures = [], []
    one_paint = rng.random() < 0.4
    for turn in range(4):
        if turn == 0 or not one_paint:
            group = str(rng.choice(WALL_GROUPS))
            drawn = _fabric(paints, 0.35) if group == "cloth" else paints.draw(group, scale=0.35)
            paint = drawn.paled(ROOM_PALE)
        wall = box((0.1, 2 * ROOM_HALF + 0.2, WALL_HEIGHT), (ROOM_HALF + 0.05, 0, FLOOR_Z + WALL_HEIGHT / 2))
        walls.append((wall.turned("z", 90 * turn), paint))
        for side in (-1, 1):
            if rng.random() < 0.3:
                wide, high = rng.uniform(0.7, 1.3), rng.uniform(0.6, 1.0)
                centre = side * rng.uniform(0.9, 1.9), FLOOR_Z + rng.uniform(1.2, 2.1)
                frame = box((0.05, wide + 0.16, high + 0.16), (ROOM_HALF - 0.02, *centre), 0.01)
                canvas = box((0.03, wide, high), (ROOM_HALF - 0.04, *centre))
                pictures.append((frame.turned("z", 90 * turn), paints.draw("wood").paled(0.3)))
                group = str(rng.choice(["collage", "plain", "stone", "plastic"]))
                pictures.append((canvas.turned("z", 90 * turn), paints.draw(group, scale=0.5).paled(0.35)))
    assembly.add_surroundings("wall", ("walls", "room wall"), walls)
    if pictures:
        assembly.add_surroundings("picture", ("painting", "framed picture"), pictures)


def _add_table(assembly: Assembly, rng: np.random.Generator, paints: PaintBox) -> None:
    """Add a round, square or octagonal table of about `TABLE_RADIUS`, sometimes with a cloth."""
    group = str(rng.choice(["wood", "wood", "stone", "collage", "plain", "tiles"]))
    top = paints.draw(group, scale=0.6).paled(0.45)
    leg = paints.draw("wood")
    outer = TABLE_RADIUS * 1.12
    shape = str(rng.choice(["round", "square", "octagonal"], p=[0.5, 0.35, 0.15]))

    def slab(grow: float, low: float, high: float) -> Mesh:
        if shape == "square":
            return box((2 * TABLE_RADIUS * grow,) * 2 + (high - low,), (0, 0, (low + high) / 2), 0.012)
        corners = np.radians(22.5 + 45 * np.arange(8))
        ring = np.stack([np.cos(corners), np.sin(corners)], axis=1) * outer * 1.05 * grow
        if shape == "octagonal":
            return loft([[(x, y, z) for x, y in ring] for z in (low, high)])
        return cylinder(outer * grow, low, high, 64, bevel=0.012)

    cloth = rng.random() < 0.35
    under = -0.012 if cloth else 0.0
    table = [(slab(1.0, -0.08, under), top)]
    if rng.random() < 0.5:
        table.append((cylinder(0.12, FLOOR_Z, -0.07), leg))
        table.append((cylinder(0.45, FLOOR_Z, FLOOR_Z + 0.06), leg))
    else:
        away = 0.62 * TABLE_RADIUS
        for x, y in CORNERS:
            foot = (x * away, y * away, FLOOR_Z / 2 - 0.03)
            table.append((box((0.12, 0.12, -FLOOR_Z), foot, 0.01), leg))
    texts = (f"{shape} table", f"{top.colour} table", "table top")
    assembly.add_surroundings("table", texts, table)
    if cloth:
        fabric = _fabric(paints, 0.5).paled(0.35)
        draped = [(slab(1.012, -0.30, 0.0), fabric)]
        if rng.random() < 0.5:  # a flat cloth, smaller than the table
            draped = [(slab(0.86, -0.015, 0.0), fabric)]
        assembly.add_surroundings("tablecloth", (f"{fabric.colour} tablecloth", "cloth"), draped)


def _fabric(paints: PaintBox, scale: float) -> Paint:
    """Draw cloth with a pattern of the given scale; a weave stays fine, because a coarse weave looks wavy."""
    paint = paints.draw("cloth", scale=scale)
    return replace(paint, scale=paint.scale * 2.2 / scale * 0.5) if paint.kind == "weave" else paint


def _lamplight(rng: np.random.Generator) -> Style:
    azimuth, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.8, 2.2)
    warm = rng.uniform(-1.3, 1.3)
    light = np.array([1.0 + 0.06 * warm, 0.97, 0.92 - 0.12 * warm]) * rng.uniform(0.8, 1.2)
    sky = np.array([0.44 - 0.05 * warm, 0.46, 0.50 + 0.05 * warm]) * rng.uniform(0.75, 1.2)
    position = np.array([away * np.cos(azimuth), away * np.sin(azimuth), rng.uniform(3.2, 4.2)])
    radius = float(rng.uniform(0.25, 0.75))
    ground = sky * np.array([0.58, 0.5, 0.42])
    return Style.of(position, radius, light, sky, ground, float(rng.uniform(1.15, 1.5)))


def ring_sights(scene: WorldScene, views: int, arc_deg: float | int) -> tuple[list[Sight], float]:
    """Return slightly jittered cameras around the table at two alternating elevations.

    Neighbouring cameras should be at most 9 degrees apart: structure from motion failed with larger steps.
    The arc is centred on +x, the direction that most objects' fronts face.
    """
    rng = np.random.default_rng([scene.seed, 5])
    target = np.array([0.0, 0.0, LOOK_AT_Z])
    sights = []
    for i, middle in enumerate(arc_azimuths(views, arc_deg)):
        azimuth = middle + rng.uniform(-1, 1)
        elevation = ELEVATIONS_DEG[i % 2] + rng.uniform(-1.5, 1.5)
        centre = target + on_sphere(azimuth, elevation, DISTANCE * rng.uniform(0.97, 1.03))
        sights.append((centre, target + rng.uniform(-0.03, 0.03, 3)))
    return sights, FOV_DEG
