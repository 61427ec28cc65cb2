"""Room scenes: furniture along the walls with small objects on it, as in ScanNet, ScanNet200 and Replica."""

import logging
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hilsplat.base.levels import NONE
from hilsplat_world.objects.builder import ObjectModel
from hilsplat_world.objects.catalogue import ROOM_THINGS
from hilsplat_world.paints import PaintBox
from hilsplat_world.scenes.floorplan import WALL_GAP, FloorPlan, Room, Space, turned_space
from hilsplat_world.scenes.scene import Assembly, PlacedObject, Style, WorldScene, footprint_of
from hilsplat_world.shapes import Mesh, box, rotation_about
from hilsplat_world.views import Sight, arc_azimuths

logger = logging.getLogger(__name__)

FURNITURE_SHARE = 0.65
"""Share of furniture among the requested objects; the others are small objects on furniture ("things")."""
PATTERN_FACTOR = 2.0
"""Factor on the pattern frequency of things, which are modelled about 0.5 m large and placed at half size."""


class Piece(NamedTuple):
    """Placement of a class of furniture."""

    name: str
    above: float  # height kept free above the piece for things on it, m
    clear: float  # depth kept free in front of the piece, m
    partners: tuple[tuple[str, str], ...] = ()  # classes placed with the piece if they fit, and where


LARGE: tuple[Piece, ...] = (
    Piece("bed", 0.0, 0.15, (("nightstand", "beside"),)),
    Piece("sofa", 0.0, 0.3),
    Piece("desk", 0.75, 0.65, (("chair", "before"), ("monitor", "on"))),
    Piece("tv stand", 0.72, 0.3, (("television", "on"),)),
    Piece("counter", 0.5, 0.4, (("sink", "on"),)),
    Piece("bookshelf", 0.0, 0.3),
    Piece("refrigerator", 0.0, 0.4),
    Piece("cabinet", 0.45, 0.3),
)
"""Pieces placed against a wall, in random order; no piece repeats before all have been used."""

SUPPORTS = ("table", "desk", "cabinet", "nightstand", "counter", "tv stand")
"""Furniture that can support things on its part or subpart "top"."""

THING_SIZES: dict[str, tuple[float, float]] = {
    "mug": (0.15, 0.2), "kettle": (0.24, 0.3), "bottle": (0.3, 0.36), "cake": (0.22, 0.28),
    "fruit basket": (0.22, 0.28), "toaster": (0.2, 0.26), "radio": (0.22, 0.28), "camera": (0.18, 0.24),
    "lantern": (0.3, 0.36), "clock": (0.26, 0.32), "backpack": (0.4, 0.46), "plant": (0.42, 0.55),
}  # fmt: skip
"""Heights of some things, m; slightly oversized, so that subparts are visible across a room."""
TOY_SIZE = (0.34, 0.44)  # heights of all other things, m
MAX_THING_RADIUS = 0.21
EDGE = 0.03
"""Minimum distance between things and the edge of their support, or the wall behind a counter, m."""
MAX_FLAT = 0.05  # maximum height of a flat item above its board for things to be placed on the item, m

WALL_PALE, FLOOR_PALE, CEILING_PALE = 0.6, 0.4, 0.2
"""Shares of grey mixed into the colours of walls, floor and ceiling, so that objects stand out."""

FOV_DEG = 62.0
EYE_HEIGHTS = (1.34, 1.7)
"""Alternating camera heights, m; the difference adds parallax that the loop alone lacks."""
PATH_SHARE = 0.27  # semi-axes of the camera loop, as shares of the room's width and depth
LOOK_AT_Z = 0.78


class _Furnishing:
    """A room that is being furnished: the scene so far, occupied space, and supports for things."""

    def __init__(self, seed: int, rng: np.random.Generator, plan: FloorPlan) -> None:
        self.rng, self.plan = rng, plan
        self.assembly = Assembly("room", seed)
        self.placed: list[PlacedObject] = []
        self.supports: list[Support] = []

    def put(
        self, model: ObjectModel, spot: np.ndarray, yaw_deg: float, base_z: float = 0.0, scale: float = 1.0
    ) -> None:
        """Add an object centred at `spot` in x and y."""
        low, high = model.triangles.min(axis=(0, 1)) * scale, model.triangles.max(axis=(0, 1)) * scale
        middle = (low + high)[:2] / 2
        xy = spot - rotation_about("z", yaw_deg)[:2, :2] @ middle
        node = self.assembly.add_object(model, scale, xy, yaw_deg, base_z)
        triangles = self.assembly.pieces[-1][0]
        (x, y), radius = footprint_of(triangles)
        height = float(triangles[..., 2].max()) - base_z
        self.placed.append(
            PlacedObject(model.name, node, (float(x), float(y)), radius, height, yaw_deg, base_z)
        )
        if model.name in SUPPORTS:
            self.supports.append(_support(model, triangles))


class Support(NamedTuple):
    """Top of a piece of furniture."""

    top: Space  # of the board
    flat: list[Space]  # of flat items on the board, such as a table runner
    stand: list[tuple[np.ndarray, float]]  # centres and radii of the footprints already on the board

    def height_at(self, spot: np.ndarray, radius: float) -> float:
        """Return the base height for a footprint: the board's, or that of the highest flat item below it."""
        reach = np.array([radius, radius])
        below = Space((*(spot - reach).tolist(), -1.0), (*(spot + reach).tolist(), 1e3))
        return max([self.top.high[2], *(space.high[2] for space in self.flat if space.meets(below, 0.0))])


def _support(model: ObjectModel, triangles: np.ndarray) -> Support:
    node = next(node for node in model.nodes if node.text == f"{model.name} top")
    in_top, subparts = model.node_ids[:, node.level - 1] == node.id, model.node_ids[:, 2]
    board = in_top & (subparts == NONE) if node.level == 2 else in_top
    top = Space.of(triangles[board].reshape(-1, 3))
    rows = np.unique(subparts[in_top & ~board])
    items = [Space.of(triangles[subparts == row].reshape(-1, 3)) for row in rows]
    return Support(top, [item for item in items if item.high[2] < top.high[2] + MAX_FLAT], [])


def size_of(model: ObjectModel) -> Float[np.ndarray, " 3"]:
    """Return depth, width and height of an object in its own frame, scene units."""
    return np.ptp(model.triangles.reshape(-1, 3), axis=0)


def build_room(seed: int, objects: int) -> WorldScene:
    """Build a room of about 4 x 5 m, in metres, with furniture against the walls and the floor at z = 0.

    Every room has a door, a window with a curtain, and two pictures (or a picture and a mirror). About two
    thirds of `objects` are furniture; the others are things on furniture, or on the floor if no support is
    free. Objects that do not fit are omitted, and the camera loop stays free.
    """
    rng = np.random.default_rng([seed, 21])
    room = Room(float(rng.uniform(4.4, 5.0)), float(rng.uniform(3.8, 4.3)), 2.55)
    plan = FloorPlan(room, path_points(room, np.linspace(0, 360, 72, endpoint=False)))
    work = _Furnishing(seed, rng, plan)
    _add_fixtures(work)
    furniture = _furnish(work, max(1, round(FURNITURE_SHARE * objects)))
    pictures = _hang_pictures(work)
    count = objects - furniture
    names = [str(name) for _ in range(1 + count // len(ROOM_THINGS)) for name in rng.permutation(ROOM_THINGS)]
    things = sum(_add_thing(work, name) for name in names[:count])
    logger.info(
        "scene room:%d: %d pieces of furniture and %d things (%d objects requested), %d fixtures: %s",
        seed, furniture, things, objects, 3 + pictures, ", ".join(thing.name for thing in work.placed),
    )  # fmt: skip
    _add_shell(work.assembly, room, np.random.default_rng([seed, 23]))
    style = _style(room, np.random.default_rng([seed, 24]))
    asked = objects + 5  # with door, window, curtain and two pictures
    return work.assembly.finished(asked, work.placed, style)


def _add_fixtures(work: _Furnishing) -> None:
    room, plan = work.plan.room, work.plan
    door_wall, window_wall = (int(wall) for wall in work.rng.permutation(4)[:2])
    model = work.assembly.draw("door")
    size = size_of(model)
    reach = room.wall_length(door_wall) / 2 - size[1] / 2 - 0.12
    along = float(work.rng.choice([-1, 1]) * reach * work.rng.uniform(0.6, 1.0))
    yaw = 90.0 * door_wall
    work.put(model, room.at_wall(door_wall, along, size[0] / 2), yaw)
    # The entrance and the swing of the door stay free.
    entrance = room.at_wall(door_wall, along, 0.4)
    plan.taken.append(turned_space(entrance, np.array([0.8, size[1], 2.1]), yaw, 0.0))
    yaw = 90.0 * window_wall
    along = float(work.rng.uniform(-0.3, 0.3))
    for name, base_z in (("window", 0.92), ("curtain", 0.84)):
        model = work.assembly.draw(name)
        size = size_of(model)
        spot = room.at_wall(window_wall, along, size[0] / 2)
        work.put(model, spot, yaw, base_z)
    plan.taken.append(turned_space(spot, size, yaw, base_z))


def _furnish(work: _Furnishing, count: int) -> int:
    """Place pieces and partners against the walls, and a table in the middle; return the number placed."""
    done, failures = 0, 0
    queue: list[Piece] = []
    with_rug = count >= 4 and bool(work.rng.random() < 0.5)
    # The table is placed last, in the remaining space; lamp and stool are added after this many pieces.
    extras = [(5, "lamp"), (7, "stool")]
    table_at = count - 1 - with_rug if count >= 3 else count
    while done < count and failures < 2 * len(LARGE):
        if done >= table_at:
            table_at = count
            done += _put_table(work, with_rug and done + 2 <= count)
            continue
        if extras and done >= extras[0][0]:
            done += _put_at_wall(work, Piece(extras.pop(0)[1], 0.0, 0.0))
            continue
        if not queue:
            queue = [LARGE[row] for row in work.rng.permutation(len(LARGE))]
        piece = queue.pop()
        if not _put_at_wall(work, piece):
            failures += 1
            continue
        done += 1
        owner = len(work.placed) - 1
        for name, where in piece.partners:
            if done < count:
                done += _put_partner(work, owner, name, where)
    if done < count:
        logger.warning(
            "scene room:%d: no space left for %d pieces of furniture", work.assembly.seed, count - done
        )
    return done


def _put_at_wall(work: _Furnishing, piece: Piece, base_z: float = 0.0, gap: float = WALL_GAP) -> bool:
    """Place a piece against a wall, and return whether it fits."""
    model = work.assembly.draw(piece.name)
    size = size_of(model) + np.array([0, 0, piece.above])
    spot = work.plan.wall_spot(work.rng, size, base_z, piece.clear, gap)
    if spot is not None:
        work.put(model, *spot, base_z)
    return spot is not None


ON_TOP: dict[str, float] = {"television": -0.03, "monitor": -0.12, "sink": 0.0}
"""Offset of a partner from the middle of its support towards the front, m."""


def _put_partner(work: _Furnishing, owner_row: int, name: str, where: str) -> bool:
    """Place a partner before, beside or on its owner; return whether it fits."""
    model = work.assembly.draw(name)
    size = size_of(model)
    owner = work.placed[owner_row]
    turn, middle = rotation_about("z", owner.yaw_deg)[:2, :2], np.array(owner.centre_xy)
    if where == "on":
        support = work.supports[-1]
        spot = middle + turn @ np.array([ON_TOP[name], 0.0])
        radius = float(np.linalg.norm(size[:2]) / 2)
        support.stand.append((spot, radius))
        work.put(model, spot, owner.yaw_deg, support.height_at(spot, 0.4 * radius))
        return True
    corners = np.concatenate(work.assembly.pieces[owner_row][0])
    half_depth, half_width = np.ptp((corners[:, :2] - middle) @ turn, axis=0) / 2
    for side in work.rng.permutation([-1.0, 1.0]):
        if where == "before":
            offset, yaw = np.array([half_depth + size[0] / 2 + 0.06, -0.1 * half_width]), owner.yaw_deg + 180
        else:
            offset = np.array([size[0] / 2 - half_depth, side * (half_width + size[1] / 2 + 0.06)])
            yaw = owner.yaw_deg
        spot = middle + turn @ offset
        space = turned_space(spot, size + np.array([0, 0, 0.45 if name in SUPPORTS else 0.0]), yaw, 0.0)
        if work.plan.claim(space, 0.02):
            work.put(model, spot, yaw)
            return True
    return False


def _put_table(work: _Furnishing, with_rug: bool) -> int:
    """Place a table near the middle of the room, optionally on a rug; return the number of pieces placed."""
    model, rug = work.assembly.draw("table"), work.assembly.draw("rug")
    size = size_of(rug) if with_rug else size_of(model)
    base_z = float(size_of(rug)[2]) if with_rug else 0.0
    for attempt in range(80):
        yaw = 90.0 * int(work.rng.integers(4))
        spot = work.rng.uniform(-1, 1, 2) * np.array([1.6, 1.0]) * (0.15 + 0.006 * attempt)
        space = turned_space(spot, np.array([size[0], size[1], size_of(model)[2] + 0.46]), yaw, 0.0)
        if work.plan.claim(space, 0.25):
            if with_rug:
                work.put(rug, spot, yaw)
            work.put(model, spot, yaw, base_z)
            return 1 + with_rug
    return 0


def _hang_pictures(work: _Furnishing) -> int:
    """Hang a picture, and a second picture or a mirror, at eye height; return the number hung."""
    names = ("picture", str(work.rng.choice(["picture", "mirror"])))
    pieces = [Piece(name, 0.0, 0.25) for name in names]
    return sum(_put_at_wall(work, piece, float(work.rng.uniform(1.28, 1.4)), gap=0.0) for piece in pieces)


def _add_thing(work: _Furnishing, name: str) -> bool:
    """Place a thing on furniture or the floor, facing the middle of the room; return whether it fits."""
    model = work.assembly.draw(name, "tabletop")
    _, radius = footprint_of(model.triangles)
    height = float(model.triangles[..., 2].max())
    target = float(work.rng.uniform(*THING_SIZES.get(name, TOY_SIZE)))
    scale = min(target / height, MAX_THING_RADIUS / radius)
    radius *= scale
    pattern = model.materials.copy()
    pattern[:, 7] *= PATTERN_FACTOR  # texture cells per metre, see Paint.row
    model = replace(model, materials=pattern)
    position = _thing_spot(work, radius, height * scale)
    if position is None:
        logger.warning("scene room:%d: no space left for the %s", work.assembly.seed, name)
        return False
    spot, base_z = position
    yaw = float(np.degrees(np.arctan2(-spot[1], -spot[0])) + work.rng.uniform(-50, 50))
    # The footprint is a circle that rotates about its centre, so the yaw does not move it.
    work.put(model, spot, yaw, base_z, scale)
    return True


def _thing_spot(work: _Furnishing, radius: float, height: float) -> tuple[np.ndarray, float] | None:
    """Return a spot and base height on the emptiest support with free space, else on the floor by a wall."""
    for support in sorted(work.supports, key=lambda support: (len(support.stand), work.rng.random())):
        low = np.array(support.top.low[:2]) + radius + EDGE
        high = np.array(support.top.high[:2]) - radius - EDGE
        if (high <= low).any():
            continue
        for _ in range(60):
            spot = work.rng.uniform(low, high)
            if all(np.linalg.norm(spot - other) > radius + size + 0.02 for other, size in support.stand):
                support.stand.append((spot, radius))
                return spot, support.height_at(spot, 0.6 * radius)
    size = np.array([2 * radius, 2 * radius, height])
    at_wall = work.plan.wall_spot(work.rng, size, 0.0, 0.2, gap=WALL_GAP + 0.05)
    return None if at_wall is None else (at_wall[0], 0.0)


def _add_shell(assembly: Assembly, room: Room, rng: np.random.Generator) -> None:
    """Add floor, walls with skirting, and ceiling, textured for structure from motion."""
    paints = PaintBox(rng)
    w, d, h = room.width, room.depth, room.height
    group = str(rng.choice(["wood", "wood", "stone", "collage", "cloth"]))
    floor = paints.draw(group, scale=0.45).paled(FLOOR_PALE)
    ceiling = paints.draw("plain white beige", scale=0.4).paled(CEILING_PALE)
    skirting = paints.draw("wood")
    plane = _plane(w, d)
    assembly.add_surroundings("floor", ("ground", f"{floor.colour} floor"), [(plane, floor)])
    pieces = []
    for wall in range(4):
        group = str(rng.choice(["brick", "collage", "stone", "plain", "cloth"]))
        paint = paints.draw(group, scale=0.4).paled(WALL_PALE)
        half, length = (w / 2, d) if wall % 2 == 0 else (d / 2, w)
        upright = _plane(h, length).turned("y", 90).moved(-half, 0, h / 2)
        board = box((0.018, length - 0.04, 0.09), (0.009 - half, 0, 0.045), 0.004)
        pieces += [(upright.turned("z", 90 * wall), paint), (board.turned("z", 90 * wall), skirting)]
    assembly.add_surroundings("wall", ("walls", "room wall"), pieces)
    above = plane.turned("x", 180).moved(0, 0, h)
    assembly.add_surroundings("ceiling", ("room ceiling",), [(above, ceiling)])


def _plane(x: float, y: float) -> Mesh:
    """Return a rectangle that is centred at the origin and faces up."""
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]]) / 2
    triangles = corners[[[0, 1, 2], [0, 2, 3]]]
    return Mesh(triangles, np.broadcast_to([0.0, 0.0, 1.0], triangles.shape).copy())


def _style(room: Room, rng: np.random.Generator) -> Style:
    """Draw the light of a closed room: a wide ceiling lamp and strong ambient light.

    The lamp does not light the ceiling, which would be overexposed around the lamp.
    """
    warm = rng.uniform(-1, 1)
    position = np.array([*rng.uniform(-0.4, 0.4, 2), room.height - 0.02])
    light = np.array([1.0 + 0.05 * warm, 0.97, 0.92 - 0.08 * warm]) * rng.uniform(0.27, 0.33)
    sky = np.array([0.50 - 0.04 * warm, 0.51, 0.53 + 0.04 * warm]) * rng.uniform(0.92, 1.05)
    radius = float(rng.uniform(0.5, 0.7))
    ground = sky * np.array([1.12, 1.06, 0.98])
    return Style.of(position, radius, light, sky, ground, float(rng.uniform(1.05, 1.2)))


def path_points(room: Room, azimuths_deg: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 2"]:
    """Return points (x, y) on the camera loop, an ellipse about the middle of the room."""
    angle = np.radians(azimuths_deg)
    axes = PATH_SHARE * np.array([room.width, room.depth])
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) * axes


def room_of(scene: WorldScene) -> Room:
    """Return the interior dimensions of a room scene."""
    high = scene.triangles.reshape(-1, 3).max(axis=0)
    return Room(2 * float(high[0]), 2 * float(high[1]), float(high[2]))


def loop_sights(scene: WorldScene, views: int, arc_deg: float | int) -> tuple[list[Sight], float]:
    """Return cameras on a loop through the room, looking across its middle from two alternating heights.

    The views show the far wall with everything in front of it, and the middle from all sides. Views of a
    camera that rotates in place would have no parallax.
    """
    rng = np.random.default_rng([scene.seed, 25])
    spots = path_points(room_of(scene), arc_azimuths(views, arc_deg) + rng.uniform(-1, 1, views))
    sights = []
    for i, spot in enumerate(spots):
        centre = np.array([*spot, EYE_HEIGHTS[i % 2] + rng.uniform(-0.03, 0.03)])
        sights.append((centre, np.array([*(-0.5 * spot), LOOK_AT_Z]) + rng.uniform(-0.04, 0.04, 3)))
    return sights, FOV_DEG
