"""Surroundings of a street: road, markings, kerbs, sidewalks, ground and sky. Lengths are metres."""

import numpy as np

from hilsplat.world.paints import Colour, Paint
from hilsplat.world.scenes.scene import Assembly
from hilsplat.world.shapes import Mesh, box, joined, lathe

LANE = 3.2
KERB = 5.7
"""Half the width of the road, m: a lane and a parking strip."""
FRONT = 8.7
"""Distance of the house fronts from the middle of the road, m."""
WALK_Z = 0.14
SCALE = 4.0
"""`Style.scale`: textures and occlusion distance are four times as large as on a table."""
ROAD_X = (-34.0, 50.0)
DOME_RADIUS = 115.0
DOME_HEIGHT = 62.0
CROSSING_X = (14.2, 16.8)


def add_ground(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add the surroundings as wholes without parts.

    Their texts are those of the Waymo classes (road, lane marker, curb, sidewalk, other ground).
    """
    middle, length = (ROAD_X[0] + ROAD_X[1]) / 2, ROAD_X[1] - ROAD_X[0]
    tar, pale = float(rng.uniform(0.34, 0.44)), rng.uniform(0.02, 0.06, 3)
    lighter = tuple((1.22 * tar + pale).tolist())
    asphalt = _paint("grey", "mottled", (tar, tar, 1.03 * tar), lighter, 22.0, rng)
    flags = _paint("beige", "collage", (0.66, 0.62, 0.56), (0.55, 0.53, 0.52), float(rng.uniform(8, 12)), rng)
    stone = _paint("white", "stone", (0.78, 0.77, 0.74), (0.62, 0.62, 0.62), 10.0, rng)
    lines = _paint("white", "mottled", (0.88, 0.88, 0.86), (0.72, 0.72, 0.70), 10.0, rng)
    grass = _paint("green", "mottled", (0.34, 0.50, 0.22), (0.46, 0.56, 0.30), 6.0, rng)
    road = [(box((length, 2 * KERB, 0.2), (middle, 0, -0.1)), asphalt)]
    road.append((_patches(rng), _paint("black", "mottled", (0.22, 0.22, 0.24), (0.30, 0.30, 0.32), 9.0, rng)))
    assembly.add_surroundings("road", ("street", "asphalt", "roadway"), road)
    assembly.add_surroundings("lane marker", ("lane marking", "road marking"), [(_markings(), lines)])
    kerbs, walks = [], []
    wide = FRONT - KERB - 0.2
    for side in (-1, 1):
        kerb = box((length, 0.2, WALK_Z + 0.1), (middle, side * (KERB + 0.1), WALK_Z / 2 - 0.05))
        walk = box((length, wide + 0.6, 0.2), (middle, side * (KERB + 0.5 + wide / 2), WALK_Z - 0.1))
        kerbs.append((kerb, stone))
        walks.append((walk, flags))
    assembly.add_surroundings("curb", ("kerb", "curbstone"), kerbs)
    assembly.add_surroundings("sidewalk", ("pavement", "footpath"), walks)
    lawn = box((2 * DOME_RADIUS, 2 * DOME_RADIUS, 0.2), (middle, 0, -0.13))
    assembly.add_surroundings("ground", ("other ground", "lawn"), [(lawn, grass)])
    blue = (0.36 + 0.08 * float(rng.random()), 0.60, 0.90)
    offset = tuple(rng.uniform(3, 90, 3).tolist())
    sky = Paint("blue", "mottled", blue, (0.93, 0.94, 0.96), 0.42, 0.0, 0.0, 0.0, offset)
    assembly.add_surroundings("sky", ("clouds", "blue sky"), [(_dome(middle), sky)])


def _paint(
    colour: str, kind: str, first: Colour, second: Colour, scale: float, rng: np.random.Generator
) -> Paint:
    """Return a dull paint with strong grain, because structure from motion needs detail on large surfaces."""
    offset = tuple(rng.uniform(3.0, 17.0, 3).tolist())
    return Paint(colour, kind, first, second, scale, 0.03, 8.0, 0.34, offset)


def _patches(rng: np.random.Generator) -> Mesh:
    """Return repaired patches and manhole covers of the road."""
    pieces = []
    for _ in range(14):
        size = (float(rng.uniform(0.6, 2.2)), float(rng.uniform(0.5, 1.6)), 0.02)
        y = float(rng.uniform(-KERB + 1.0, KERB - 1.0))
        pieces.append(box(size, (float(rng.uniform(-18, 34)), y, -0.004)))
    return joined(*pieces)


def _markings() -> Mesh:
    """Return lane dashes, lines and ticks of the parking strips, a zebra crossing and a stop line."""
    pieces = []

    def mark(x0: float, x1: float, y0: float, y1: float) -> None:
        pieces.append(box((x1 - x0, y1 - y0, 0.02), ((x0 + x1) / 2, (y0 + y1) / 2, 0.002)))

    low, high = CROSSING_X
    for x in np.arange(ROAD_X[0] + 1, ROAD_X[1] - 2, 4.0).tolist():
        if x + 2 < low - 1.5 or x > high + 0.5:
            mark(x, x + 2.0, -0.08, 0.08)
    for side in (-1.0, 1.0):
        for x0, x1 in ((ROAD_X[0], low - 0.6), (high + 0.6, ROAD_X[1])):
            mark(x0, x1, side * LANE - 0.06, side * LANE + 0.06)
        for x in np.arange(ROAD_X[0] + 3, ROAD_X[1], 6.0).tolist():
            if x < low - 0.6 or x > high + 0.6:
                edge = side * LANE
                mark(x - 0.06, x + 0.06, min(edge, side * KERB), max(edge, side * KERB))
    for y in np.arange(-KERB + 0.5, KERB - 0.5, 1.0).tolist():
        mark(low, high, y, y + 0.5)
    mark(low - 1.4, low - 1.0, -LANE + 0.2, -0.2)
    return joined(*pieces)


def _dome(middle: float) -> Mesh:
    """Return the sky: half an ellipsoid over the scene, near enough for its clouds to show parallax."""
    angle = np.linspace(-0.02, np.pi / 2, 15)
    profile = [(max(0.0, float(np.cos(a))), float(np.sin(a))) for a in angle]
    profile[-1] = (0.0, 1.0)
    return lathe(profile, 48).scaled(DOME_RADIUS, DOME_RADIUS, DOME_HEIGHT).moved(middle, 0, 0)
