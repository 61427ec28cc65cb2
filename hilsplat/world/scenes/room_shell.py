"""Floor, walls, ceiling and light of room scenes."""

import numpy as np

from hilsplat.world.paints import PaintBox
from hilsplat.world.scenes.floorplan import Room, yaw_of_wall
from hilsplat.world.scenes.scene import Assembly, Style
from hilsplat.world.shapes import Mesh, box

WALL_PALE, FLOOR_PALE, CEILING_PALE = 0.6, 0.4, 0.2
"""Shares of grey in the colours of walls, floor and ceiling, so that the objects stand out."""


def add_shell(assembly: Assembly, room: Room, rng: np.random.Generator) -> list[int]:
    """Add floor, walls with skirting and ceiling, textured for structure from motion; return their ids."""
    paints = PaintBox(rng)
    w, d, h = room.width, room.depth, room.height
    floor = paints.draw(str(rng.choice(["wood", "wood", "stone", "collage", "cloth"])), scale=0.45).paled(
        FLOOR_PALE
    )
    ceiling = paints.draw("plain", "white", "beige", scale=0.4).paled(CEILING_PALE)
    skirting = paints.draw("wood")
    plane = _plane(w, d)
    nodes = [assembly.add_surroundings("floor", ("ground", f"{floor.colour} floor"), [(plane, floor)])]
    pieces = []
    for wall in range(4):
        group = str(rng.choice(["brick", "collage", "stone", "plain", "cloth"]))
        paint = paints.draw(group, scale=0.4).paled(WALL_PALE)
        half, length = (w / 2, d) if wall % 2 == 0 else (d / 2, w)
        upright = _plane(h, length).turned("y", 90).moved(-half, 0, h / 2).turned("z", yaw_of_wall(wall))
        pieces.append((upright, paint))
        board = box((0.018, length - 0.04, 0.09), (0.009 - half, 0, 0.045), 0.004)
        pieces.append((board.turned("z", yaw_of_wall(wall)), skirting))
    nodes.append(assembly.add_surroundings("wall", ("walls", "room wall"), pieces))
    above = _plane(w, d).turned("x", 180).moved(0, 0, h)
    nodes.append(assembly.add_surroundings("ceiling", ("room ceiling",), [(above, ceiling)]))
    return nodes


def _plane(x: float, y: float) -> Mesh:
    """Return a rectangle about the origin that faces up."""
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]]) / 2
    triangles = corners[[[0, 1, 2], [0, 2, 3]]]
    return Mesh(triangles, np.broadcast_to([0.0, 0.0, 1.0], triangles.shape).copy())


def room_style(room: Room, rng: np.random.Generator) -> Style:
    """Draw the light of a closed room: a wide ceiling lamp and strong ambient light.

    The lamp does not light the ceiling, which would be overexposed around it.
    """
    warm = rng.uniform(-1, 1)
    place = rng.uniform(-0.4, 0.4, 2)
    light = np.array([1.0 + 0.05 * warm, 0.97, 0.92 - 0.08 * warm]) * rng.uniform(0.27, 0.33)
    sky = np.array([0.50 - 0.04 * warm, 0.51, 0.53 + 0.04 * warm]) * rng.uniform(0.92, 1.05)
    return Style(
        (float(place[0]), float(place[1]), room.height - 0.02),
        float(rng.uniform(0.5, 0.7)),
        tuple(light.tolist()),
        tuple(sky.tolist()),
        tuple((sky * np.array([1.12, 1.06, 0.98])).tolist()),
        float(rng.uniform(1.05, 1.2)),
    )
