"""Street scenes: a drive past houses, vehicles, people, trees and signs, as in Waymo. Lengths are in metres.

x points along the street, y to the left of a driver facing +x, and z up; the road is at z = 0.
"""

import logging
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hilsplat_world.objects.builder import ObjectModel
from hilsplat_world.paints import Colour, Paint
from hilsplat_world.scenes.scene import Assembly, PlacedObject, Style, WorldScene, footprint_of
from hilsplat_world.shapes import Mesh, box, joined, lathe, rotation_about
from hilsplat_world.views import Sight, on_sphere

logger = logging.getLogger(__name__)

COUNTED = ("car", "pedestrian", "heavy", "cyclist", "car", "pedestrian", "car")
"""Mix of the requested vehicles and people; "heavy" means a truck or a bus."""
FURNITURE = (
    "traffic light", "traffic sign", "tree", "street lamp", "tree", "bush", "fence", "tree", "traffic sign",
    "bush", "street lamp", "tree", "fence", "bush",
)  # fmt: skip
"""Objects added to every street if they fit."""
STREET_X = (-26.0, 42.0)
"""Extent of the rows of buildings in x, m; additional buildings close both ends of the street."""
THINGS_X = (-9.0, 25.0)
"""Extent of vehicles, people and street furniture in x, m; all are in view during the drive."""
GAP = 0.12
TRIES = 200

LANE = 3.2
KERB = 5.7  # half the width of the road, m: one lane and one parking strip
FRONT = 8.7  # distance between the house fronts and the middle of the road, m
WALK_Z = 0.14
SCALE = 4.0  # value of `Style.scale`: textures and occlusion distance are four times as large as on a table
ROAD_X = (-34.0, 50.0)
DOME_RADIUS = 115.0
DOME_HEIGHT = 62.0
CROSSING_X = (14.2, 16.8)

LANE_Y = -LANE / 2  # middle of the driver's lane, m (traffic keeps to the right)
DRIVE_X = (-13.0, 10.5)
CAMERA_Z = 1.8
MAX_STEP = 0.51  # maximum distance between neighbouring views along the street, m
SWEEP_VIEWS = 16  # number of views in which the camera sweeps from left to right and back
SWEEP_DEG = 36.0  # amplitude of the sweep to either side of straight ahead
SWAY_M = 0.8
"""Lateral amplitude of the camera about the lane's middle in one sweep. Without this sway, the error of
structure from motion was 2.5 m instead of 0.04 m: views that rotate on a straight path have little parallax,
so the two sides of the street were reconstructed at different scales."""
FOV_DEG = 62.0
SUN_DISTANCE = 1000.0


class _Spot(NamedTuple):
    """Place for an object; `z` is its base height."""

    x: float
    y: float
    z: float
    yaw_deg: float


def part_boxes(
    triangles: Float[np.ndarray, "F 3 3"], parts: np.ndarray
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    """Return the lowest and highest corners of the boxes around an object's parts."""
    pieces = [triangles[parts == part].reshape(-1, 3) for part in np.unique(parts)]
    return np.stack([p.min(axis=0) for p in pieces]), np.stack([p.max(axis=0) for p in pieces])


class _Street:
    """A street under construction."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng([seed, 21])
        self.assembly = Assembly("street", seed, SCALE)
        self.low, self.high = np.zeros((0, 3)), np.zeros((0, 3))  # boxes around the parts placed so far

    def put(self, model: ObjectModel, spot: _Spot) -> PlacedObject | None:
        """Place an object at a spot and return it, or return None if it would intersect another object."""
        turned = model.triangles @ rotation_about("z", spot.yaw_deg).T + np.array(spot[:3])
        low, high = part_boxes(turned, model.node_ids[:, 1])
        apart = (low[:, None] - GAP > self.high) | (high[:, None] + GAP < self.low)
        if not apart.any(axis=2).all():
            return None
        self.low, self.high = np.concatenate([self.low, low]), np.concatenate([self.high, high])
        node = self.assembly.add_object(model, 1.0, np.array(spot[:2]), spot.yaw_deg, spot.z)
        (x, y), radius = footprint_of(turned)
        height = float(model.triangles[..., 2].max())
        return PlacedObject(model.name, node, (float(x), float(y)), radius, height, spot.yaw_deg, spot.z)

    def try_spots(self, name: str, spot: Callable[[ObjectModel], _Spot]) -> PlacedObject | None:
        """Place an object at the first free spot among `TRIES` random spots, or return None."""
        model = self.assembly.draw(name)
        attempts = (self.put(model, spot(model)) for _ in range(TRIES))
        return next((placed for placed in attempts if placed is not None), None)

    def vehicle_spot(self, model: ObjectModel) -> _Spot:
        """Draw a spot: parked at either kerb, oncoming, or ahead in the driver's lane."""
        rng, width = self.rng, float(np.ptp(model.triangles[..., 1]))
        half = float(np.ptp(model.triangles[..., 0])) / 2
        x = float(rng.uniform(THINGS_X[0] + half, THINGS_X[1] - half))
        kerb_y = KERB - width / 2 - float(rng.uniform(0.15, 0.3))
        tilt = float(rng.uniform(-1.5, 1.5))
        choice = rng.random()
        if choice < 0.36:
            return _Spot(x, -kerb_y, 0.0, tilt)
        if choice < 0.68:
            return _Spot(x, kerb_y, 0.0, 180 + tilt)
        if choice < 0.84:
            return _Spot(x, LANE / 2 + 0.15, 0.0, 180 + tilt)
        return _Spot(float(rng.uniform(DRIVE_X[1] + half + 5, 27 + half)), LANE_Y, 0.0, tilt)

    def cyclist_spot(self, model: ObjectModel) -> _Spot:
        """Draw a spot beside the lanes."""
        rng = self.rng
        if rng.random() < 0.5:
            return _Spot(float(rng.uniform(-2, 18)), LANE + 0.05, 0.0, 180 + float(rng.uniform(-8, 8)))
        return _Spot(float(rng.uniform(2, 20)), -LANE - 0.3, 0.0, float(rng.uniform(-8, 8)))

    def pedestrian_spot(self, model: ObjectModel) -> _Spot:
        """Draw a spot on a sidewalk, facing roughly along the sidewalk."""
        rng = self.rng
        side = -1 if rng.random() < 0.6 else 1
        yaw = float(rng.choice([0.0, 180.0]) + rng.uniform(-35, 35))
        y = side * float(rng.uniform(KERB + 1.0, FRONT - 0.9))
        return _Spot(float(rng.uniform(-6, 20)), y, WALK_Z, yaw)

    def furniture_spot(self, side: int, model: ObjectModel) -> _Spot:
        """Draw a spot beside the kerb, on the sidewalk."""
        rng = self.rng
        x, y = float(rng.uniform(*THINGS_X)), side * (KERB + (0.4 if model.name == "fence" else 0.62))
        if model.name == "traffic sign":
            return _Spot(x, y, WALK_Z, 180 + float(rng.uniform(-18, 18)))
        if model.name == "traffic light":
            return _Spot(float(rng.uniform(9.5, 13.0)), y, WALK_Z, 180 + float(rng.uniform(-8, 8)))
        return _Spot(x, y, WALK_Z, -90.0 * side)


def build_street(seed: int, objects: int) -> WorldScene:
    """Build a stretch of street with houses, street furniture, and `objects` vehicles and people.

    Vehicles are in the lanes or parked at the kerbs, people on the sidewalks, and trees, lamps, signs and
    fences beside the kerb. The part boxes of different objects do not intersect; objects that do not fit are
    omitted. About 16 vehicles and people fit; `placed` lists only vehicles and people.
    """
    street = _Street(seed)
    rng = street.rng
    houses = _add_buildings(street)
    placed = []
    order = np.concatenate([rng.permutation(len(COUNTED)) for _ in range(1 + objects // len(COUNTED))])
    for i in range(objects):
        name = COUNTED[order[i]]
        if name == "heavy":
            name = str(rng.choice(["truck", "bus"]))
        spots = {"pedestrian": street.pedestrian_spot, "cyclist": street.cyclist_spot}
        thing = street.try_spots(name, spots.get(name, street.vehicle_spot))
        if thing is None:
            logger.warning("scene street:%d: no space left for the %s", seed, name)
        else:
            placed.append(thing)
    furniture = 0
    for i, name in enumerate(FURNITURE):
        side = -1 if i <= 1 or rng.random() < 0.5 else 1
        thing = street.try_spots(name, partial(street.furniture_spot, side))
        if thing is None:
            logger.info("scene street:%d: no space left for the %s", seed, name)
        else:
            furniture += 1
    _add_ground(street.assembly, np.random.default_rng([seed, 23]))
    logger.info(
        "scene street:%d: %d of %d vehicles and people placed (%s), %d pieces of furniture, %d buildings",
        seed, len(placed), objects, ", ".join(thing.name for thing in placed), furniture, houses,
    )  # fmt: skip
    return street.assembly.finished(objects, placed, _daylight(np.random.default_rng([seed, 24])))


def _add_buildings(street: _Street) -> int:
    rng = street.rng
    houses = []

    def house() -> tuple[ObjectModel, float]:
        model = street.assembly.draw("building")
        return model, float(np.ptp(model.triangles[..., 1])) + 2 * GAP

    for side in (-1, 1):
        x = STREET_X[0] + float(rng.uniform(0, 2))
        while x < STREET_X[1] - 4:
            model, width = house()
            houses.append(street.put(model, _Spot(x + width / 2, side * FRONT, WALK_Z, -90.0 * side)))
            x += width + (float(rng.uniform(1.5, 3.0)) if rng.random() < 0.25 else 0.0)
    for x, yaw in ((STREET_X[1] + 8, 180.0), (STREET_X[0] - 8, 0.0)):
        y = -16.0
        while y < 12:
            model, width = house()
            houses.append(street.put(model, _Spot(x, y + width / 2, WALK_Z, yaw)))
            y += width
    return sum(placed is not None for placed in houses)


def _add_ground(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add the surroundings as wholes without parts.

    The queries are those of the Waymo classes (road, lane marker, curb, sidewalk, other ground).
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
    wide = FRONT - KERB - 0.2
    kerbs = box((length, 0.2, WALK_Z + 0.1)).both_sides(middle, KERB + 0.1, WALK_Z / 2 - 0.05)
    walks = box((length, wide + 0.6, 0.2)).both_sides(middle, KERB + 0.5 + wide / 2, WALK_Z - 0.1)
    assembly.add_surroundings("curb", ("kerb", "curbstone"), [(kerbs, stone)])
    assembly.add_surroundings("sidewalk", ("pavement", "footpath"), [(walks, flags)])
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
    pieces = []
    for _ in range(14):
        size = (float(rng.uniform(0.6, 2.2)), float(rng.uniform(0.5, 1.6)), 0.02)
        y = float(rng.uniform(-KERB + 1.0, KERB - 1.0))
        pieces.append(box(size, (float(rng.uniform(-18, 34)), y, -0.004)))
    return joined(*pieces)


def _markings() -> Mesh:
    """Return lane dashes, lines and ticks for parking strips, a zebra crossing and a stop line."""
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
    """Return the sky: half an ellipsoid over the scene, close enough for clouds to show parallax."""
    angle = np.linspace(-0.02, np.pi / 2, 15)
    profile = [(max(0.0, float(np.cos(a))), float(np.sin(a))) for a in angle]
    profile[-1] = (0.0, 1.0)
    return lathe(profile, 48).scaled(DOME_RADIUS, DOME_RADIUS, DOME_HEIGHT).moved(middle, 0, 0)


def _daylight(rng: np.random.Generator) -> Style:
    """Draw the sun and sky; the sun is distant, so its light is nearly constant along the street."""
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(38, 62))
    warm = rng.uniform(0, 1)
    level = np.cos(elevation)
    toward = np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])
    sun = np.array([1.0, 0.97 - 0.05 * warm, 0.90 - 0.14 * warm]) * rng.uniform(1.1, 1.35)
    # The shader's light falls off as 13 / distance^2, which is about 1 above a table.
    sun *= SUN_DISTANCE**2 / 13.0
    sky = np.array([0.40, 0.45, 0.54]) * rng.uniform(0.9, 1.1)
    ground = sky * np.array([0.62, 0.56, 0.48])
    return Style.of(SUN_DISTANCE * toward, 14.0, sun, sky, ground, float(rng.uniform(1.0, 1.15)), SCALE, 45.0)


def drive_sights(scene: WorldScene, views: int, arc_deg: float | int) -> tuple[list[Sight], float]:
    """Return the cameras of a drive along the street, for the global mapper (see `docs/world.md`).

    The camera moves along its lane and sways, while its yaw sweeps between the two sides of the street in
    steps of 9 degrees. With fewer views, the drive is shorter and the steps do not grow. `arc_deg` is unused,
    because a drive is not a ring.
    """
    rng, pitch_rng = np.random.default_rng([scene.seed, 25]), np.random.default_rng([scene.seed, 26])
    step = min(MAX_STEP, (DRIVE_X[1] - DRIVE_X[0]) / max(1, views - 1))
    start = (DRIVE_X[0] + DRIVE_X[1] - step * (views - 1)) / 2
    sights = []
    for i in range(views):
        phase = (i % SWEEP_VIEWS) / SWEEP_VIEWS
        yaw = SWEEP_DEG * (4 * abs(phase - 0.5) - 1) + float(rng.uniform(-2, 2))
        middle = np.array([start + i * step, LANE_Y + SWAY_M * np.sin(2 * np.pi * phase), CAMERA_Z])
        centre = middle + rng.uniform(-1, 1, 3) * np.array([0.05, 0.15, 0.12])
        sights.append((centre, centre + on_sphere(yaw, float(pitch_rng.uniform(-1, 3)), 1.0)))
    return sights, FOV_DEG
