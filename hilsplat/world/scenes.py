"""Scenes of the synthetic world: objects placed on a table in a room, everything drawn from a seed."""

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int32

from hilsplat.base.errors import SceneError
from hilsplat.base.levels import NONE
from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat.world.objects import CLASSES, ObjectModel, build_object
from hilsplat.world.paints import Paint, PaintBox
from hilsplat.world.shapes import Mesh, box, cylinder, rotation_about

logger = logging.getLogger(__name__)

KINDS: tuple[str, ...] = ("tabletop",)
"""Kinds of scene that can be built."""

TABLE_RADIUS = 0.9
ROOM_HALF = 3.0
FLOOR_Z = -0.75
WALL_HEIGHT = 3.4
COVERED_SHARE = 0.50
"""Share of the table top that the objects' footprints would cover, were all of them placed."""
MAX_FOOTPRINT = 0.36
MAX_HEIGHT_TO_FOOTPRINT = 2.7
GAP = 0.015
ROOM_PALE = 0.5
"""Walls and floor are mixed with this share of grey, so that the things stand out."""
TRIES = 150
LAYOUTS = 25
"""Layouts tried before an object is left out; the first that holds all is taken, else the fullest."""


@dataclass(frozen=True)
class Style:
    """Light and colour of a rendering.

    Attributes:
        light_position: centre of the round area light, scene units.
        light_radius: its radius, scene units.
        light_colour: linear RGB of its light on a surface that faces it.
        sky_colour: linear RGB of the light from above.
        ground_colour: linear RGB of the light from below.
        exposure: factor on everything.
    """

    light_position: tuple[float, float, float] = (1.3, 1.0, 3.6)
    light_radius: float = 0.45
    light_colour: tuple[float, float, float] = (1.0, 0.96, 0.88)
    sky_colour: tuple[float, float, float] = (0.42, 0.46, 0.52)
    ground_colour: tuple[float, float, float] = (0.24, 0.21, 0.18)
    exposure: float = 1.15

    @staticmethod
    def draw(rng: np.random.Generator) -> "Style":
        """A random style."""
        azimuth, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.8, 2.2)
        warm = rng.uniform(-1, 1)
        light = np.array([1.0 + 0.06 * warm, 0.97, 0.92 - 0.12 * warm]) * rng.uniform(0.85, 1.15)
        sky = np.array([0.44 - 0.05 * warm, 0.46, 0.50 + 0.05 * warm]) * rng.uniform(0.8, 1.15)
        return Style(
            (float(away * np.cos(azimuth)), float(away * np.sin(azimuth)), float(rng.uniform(3.2, 4.2))),
            float(rng.uniform(0.3, 0.6)),
            tuple(light.tolist()),
            tuple(sky.tolist()),
            tuple((sky * np.array([0.58, 0.5, 0.42])).tolist()),
            float(rng.uniform(1.0, 1.3)),
        )


@dataclass(frozen=True)
class PlacedObject:
    """Where an object stands.

    Attributes:
        name: its class.
        node: id of its whole among the nodes of the scene.
        centre_xy: middle of its footprint on the table, scene units.
        footprint: radius of the circle that holds it from above, scene units.
        height: scene units.
        yaw_deg: turn about the vertical axis; its front faces +x at 0.
    """

    name: str
    node: int
    centre_xy: tuple[float, float]
    footprint: float
    height: float
    yaw_deg: float


@dataclass(frozen=True, eq=False)
class WorldScene:
    """A scene as triangles, each of which knows what it belongs to. z is up, the table top is z = 0.

    Attributes:
        kind: what sort of scene.
        seed: everything random in it follows from this and from the number of objects.
        asked: number of objects asked for.
        placed: the objects that found a place.
        triangles: corner positions, scene units.
        normals: shading normals at the corners.
        coords: object coordinates of the corners, scene units; solid textures live in them.
        node_ids: nodes that each triangle belongs to (whole, part, subpart; -1 none).
        material_ids: row of `materials` of each triangle.
        materials: numbers for the shader, `Paint.row`.
        nodes: all nodes by id. Those of the room (table, floor, wall) are wholes without parts.
        background: ids of the room's nodes. They are labelled but never scored: large easy regions
            would lift every mean.
        style: light of this scene.
    """

    kind: str
    seed: int
    asked: int
    placed: tuple[PlacedObject, ...]
    triangles: Float32[np.ndarray, "F 3 3"]
    normals: Float32[np.ndarray, "F 3 3"]
    coords: Float32[np.ndarray, "F 3 3"]
    node_ids: Int32[np.ndarray, "F 3"]
    material_ids: Int32[np.ndarray, " F"]
    materials: Float32[np.ndarray, "M 14"]
    nodes: tuple[AnnotatedNode, ...]
    background: frozenset[int]
    style: Style

    @cached_property
    def embree(self) -> object:
        """Ray-casting structure, built on first use."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        scene = EmbreeScene()
        TriangleMesh(scene, self.triangles)
        return scene


class _Assembly:
    """Collects triangles, materials and nodes of a scene while it is built."""

    def __init__(self) -> None:
        self.triangles: list[np.ndarray] = []
        self.normals: list[np.ndarray] = []
        self.coords: list[np.ndarray] = []
        self.node_ids: list[np.ndarray] = []
        self.material_ids: list[np.ndarray] = []
        self.materials: list[np.ndarray] = []
        self.nodes: list[AnnotatedNode] = []

    def add_object(self, model: ObjectModel, scale: float, xy: np.ndarray, yaw_deg: float) -> int:
        """Add an object, scaled, turned, then moved; returns the id of its whole."""
        first, materials = len(self.nodes), sum(len(rows) for rows in self.materials)
        for row, node in enumerate(model.nodes):
            parent = NONE if node.parent == NONE else first + node.parent
            self.nodes.append(AnnotatedNode(first + row, node.level, parent, node.text, node.synonyms))
        rotation = rotation_about("z", yaw_deg)
        local = model.triangles * scale
        self.coords.append(local)
        self.triangles.append(local @ rotation.T + np.array([xy[0], xy[1], 0.0]))
        self.normals.append(model.normals @ rotation.T)
        self.node_ids.append(np.where(model.node_ids == NONE, NONE, model.node_ids + first))
        self.material_ids.append(model.material_ids + materials)
        self.materials.append(model.materials)
        return first

    def add_room(self, text: str, synonyms: tuple[str, ...], pieces: list[tuple[Mesh, Paint]]) -> int:
        """Add a piece of the room; returns its node id."""
        node = len(self.nodes)
        self.nodes.append(AnnotatedNode(node, 1, NONE, text, synonyms))
        for mesh, paint in pieces:
            self.coords.append(mesh.triangles)
            self.triangles.append(mesh.triangles)
            self.normals.append(mesh.normals)
            self.node_ids.append(np.tile(np.int32([node, NONE, NONE]), (len(mesh), 1)))
            self.material_ids.append(np.full(len(mesh), sum(len(rows) for rows in self.materials), np.int32))
            self.materials.append(paint.row()[None])
        return node


def footprint_of(triangles: Float[np.ndarray, "F 3 3"]) -> tuple[Float[np.ndarray, " 2"], float]:
    """Centre and radius of a circle in the x-y plane that holds the triangles, seen from above."""
    points = triangles.reshape(-1, 3)[:, :2]
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def build_scene(kind: str, seed: int, objects: int) -> WorldScene:
    """Build a scene. The more objects are asked for, the smaller each is.

    Objects are of different classes while there are enough classes. Each is put at a random place
    where its footprint meets no other; one that finds no place is left out.

    Args:
        kind: "tabletop".
        seed: not negative; same seed and number of objects, same scene.
        objects: how many to place.

    Raises:
        SceneError: the kind is unknown, or a number is out of range.
    """
    if kind not in KINDS:
        raise SceneError(
            f"unknown kind of synthetic scene {kind!r}",
            expected=f"one of: {', '.join(KINDS)}",
            fix="name a known kind in the scene sheet, as in world:tabletop:201",
        )
    if seed < 0 or objects < 1:
        raise SceneError(
            "a synthetic scene needs a seed of at least 0 and at least one object",
            found=f"seed {seed}, {objects} objects",
        )
    rng = np.random.default_rng([seed, 1])
    assembly = _Assembly()
    order = np.concatenate([rng.permutation(len(CLASSES)) for _ in range(1 + objects // len(CLASSES))])
    typical = min(MAX_FOOTPRINT, TABLE_RADIUS * float(np.sqrt(COVERED_SHARE / objects)))
    drawn = []
    for i in range(objects):
        name = CLASSES[order[i]]
        model = build_object(name, np.random.default_rng([seed, 2, i]))
        centre, radius = footprint_of(model.triangles)
        height = float(model.triangles[..., 2].max())
        size = typical * float(rng.uniform(0.92, 1.08))
        scale = min(size / radius, MAX_HEIGHT_TO_FOOTPRINT * size / height)
        drawn.append((name, model, centre * scale, radius * scale, height * scale, scale))
    drawn.sort(key=lambda entry: -entry[3])
    spots = _layout(rng, [entry[3] for entry in drawn])
    placed: list[PlacedObject] = []
    for (name, model, centre, radius, height, scale), spot in zip(drawn, spots, strict=True):
        if spot is None:
            logger.warning("scene %s:%d: no place left for the %s", kind, seed, name)
            continue
        yaw = float(rng.uniform(-110, 110))
        xy = spot - rotation_about("z", yaw)[:2, :2] @ centre
        node = assembly.add_object(model, scale, xy, yaw)
        placed.append(PlacedObject(name, node, (float(spot[0]), float(spot[1])), radius, height, yaw))
    logger.info("scene %s:%d: %d of %d objects placed", kind, seed, len(placed), objects)
    background = _add_room(assembly, np.random.default_rng([seed, 3]))
    return WorldScene(
        kind,
        seed,
        objects,
        tuple(placed),
        np.concatenate(assembly.triangles).astype(np.float32),
        np.concatenate(assembly.normals).astype(np.float32),
        np.concatenate(assembly.coords).astype(np.float32),
        np.concatenate(assembly.node_ids).astype(np.int32),
        np.concatenate(assembly.material_ids).astype(np.int32),
        np.concatenate(assembly.materials).astype(np.float32),
        tuple(assembly.nodes),
        frozenset(background),
        Style.draw(np.random.default_rng([seed, 4])),
    )


def _layout(rng: np.random.Generator, radii: list[float]) -> list[Float[np.ndarray, " 2"] | None]:
    """Random places on the table for footprints, given largest first; None for those left out.

    Each is drawn until it meets no earlier one, at most `TRIES` times; at most `LAYOUTS` layouts.
    """
    best: list[np.ndarray | None] = []
    most = -1
    for _ in range(LAYOUTS):
        spots: list[np.ndarray | None] = []
        taken: list[tuple[np.ndarray, float]] = []
        for radius in radii:
            reach = TABLE_RADIUS - 0.6 * radius  # objects may overhang the edge a little, as real ones do
            spots.append(None)
            for _ in range(TRIES):
                angle, away = rng.uniform(0, 2 * np.pi), reach * np.sqrt(rng.uniform())
                spot = np.array([away * np.cos(angle), away * np.sin(angle)])
                if all(np.hypot(*(spot - other)) >= radius + size + GAP for other, size in taken):
                    taken.append((spot, radius))
                    spots[-1] = spot
                    break
        if len(taken) > most:
            best, most = spots, len(taken)
        if most == len(radii):
            break
    return best


def _add_room(assembly: _Assembly, rng: np.random.Generator) -> list[int]:
    """Table, floor and walls; their textures are rich, for structure from motion."""
    paints = PaintBox(rng)
    top = paints.draw(str(rng.choice(["wood", "cloth", "stone", "collage"])), scale=0.6).paled(0.25)
    leg = paints.draw("wood")
    top_radius = TABLE_RADIUS * 1.12
    table = [
        (cylinder(top_radius, -0.07, 0.0, 64, bevel=0.012), top),
        (cylinder(0.12, FLOOR_Z, -0.07), leg),
        (cylinder(0.45, FLOOR_Z, FLOOR_Z + 0.06), leg),
    ]
    floor = paints.draw(str(rng.choice(["wood", "collage", "stone", "brick"])), scale=0.35).paled(ROOM_PALE)
    half = ROOM_HALF
    nodes = [assembly.add_room("table", ("round table", f"{top.colour} table", "table top"), table)]
    ground = box((2 * half, 2 * half, 0.1), (0, 0, FLOOR_Z - 0.05))
    nodes.append(assembly.add_room("floor", ("ground", f"{floor.colour} floor"), [(ground, floor)]))
    walls = []
    for turn in range(4):
        group = str(rng.choice(["brick", "collage", "stone", "plain", "cloth"]))
        paint = paints.draw(group, scale=0.35).paled(ROOM_PALE)
        wall = box((0.1, 2 * half + 0.2, WALL_HEIGHT), (half + 0.05, 0, FLOOR_Z + WALL_HEIGHT / 2))
        walls.append((wall.turned("z", 90 * turn), paint))
    nodes.append(assembly.add_room("wall", ("walls", "room wall"), walls))
    return nodes
