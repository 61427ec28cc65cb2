"""A scene of the synthetic world: triangles with their nodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int32

from hilsplat.base.levels import NONE
from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat_world.objects.builder import ObjectModel
from hilsplat_world.objects.catalogue import build_object
from hilsplat_world.paints import Paint
from hilsplat_world.rays import RayCaster
from hilsplat_world.shapes import Mesh, rotation_about


@dataclass(frozen=True)
class Style:
    """Light and colour of a rendering.

    Attributes:
        light_position: centre of the round area light, scene units.
        light_radius: radius of the light, scene units.
        light_colour: linear RGB of the area light on a surface that faces it.
        sky_colour: linear RGB of the light from above.
        ground_colour: linear RGB of the light from below.
        exposure: factor on all reflected light.
        scale: size of the scene relative to a tabletop (1 for a table, 4 for a street); scales grain,
            occlusion distance and ray jitter.
        shadow_reach: maximum distance of shadow casters, scene units; keeps the sky dome from hiding the sun.
    """

    light_position: tuple[float, float, float] = (1.3, 1.0, 3.6)
    light_radius: float = 0.45
    light_colour: tuple[float, float, float] = (1.0, 0.96, 0.88)
    sky_colour: tuple[float, float, float] = (0.42, 0.46, 0.52)
    ground_colour: tuple[float, float, float] = (0.24, 0.21, 0.18)
    exposure: float = 1.15
    scale: float = 1.0
    shadow_reach: float = 1e9

    @staticmethod
    def draw(rng: np.random.Generator) -> "Style":
        """Draw a random style."""
        azimuth, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.8, 2.2)
        warm = rng.uniform(-1.3, 1.3)
        light = np.array([1.0 + 0.06 * warm, 0.97, 0.92 - 0.12 * warm]) * rng.uniform(0.8, 1.2)
        sky = np.array([0.44 - 0.05 * warm, 0.46, 0.50 + 0.05 * warm]) * rng.uniform(0.75, 1.2)
        x, y, z = away * np.cos(azimuth), away * np.sin(azimuth), rng.uniform(3.2, 4.2)
        radius = float(rng.uniform(0.25, 0.75))
        ground = sky * np.array([0.58, 0.5, 0.42])
        sun, above, below = (tuple(colour.tolist()) for colour in (light, sky, ground))
        exposure = float(rng.uniform(1.15, 1.5))
        return Style((float(x), float(y), float(z)), radius, sun, above, below, exposure)


@dataclass(frozen=True)
class PlacedObject:
    """Class and position of a placed object.

    Attributes:
        name: class of the object.
        node: id of the object's whole in the scene.
        centre_xy: centre of the footprint, scene units.
        footprint: radius of the enclosing circle in the x-y plane, scene units.
        height: height of the object, scene units.
        yaw_deg: rotation about the vertical axis; the front faces +x at 0.
        base_z: height of the surface under the object, scene units.
    """

    name: str
    node: int
    centre_xy: tuple[float, float]
    footprint: float
    height: float
    yaw_deg: float
    base_z: float = 0.0


@dataclass(frozen=True, eq=False)
class WorldScene:
    """A scene as triangles with their nodes. z is up.

    Attributes:
        seed: together with the number of objects, determines all random choices in the scene.
        asked: number of requested objects.
        triangles: corner positions, scene units.
        normals: shading normals at the corners.
        coords: object coordinates of the corners, scene units, at which solid textures are evaluated.
        node_ids: nodes of each triangle (whole, part, subpart; -1: none).
        material_ids: row in `materials` for each triangle.
        materials: shader parameters (`Paint.row`).
        nodes: all nodes by id. The surroundings (table, floor, wall) are wholes without parts.
        background: ids of the surroundings, which are labelled but never scored, because large, easy regions
            would raise every mean score.
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
    def caster(self) -> RayCaster:
        """Ray caster for the triangles, built on first use."""
        return RayCaster(self.triangles)


class Assembly:
    """Triangles, materials and nodes of a scene under construction.

    Each piece has the columns of `WorldScene` from `triangles` to `material_ids`.

    Args:
        scale: scene units per unit of the solid textures, as in `Style.scale`.
    """

    def __init__(self, kind: str, seed: int, scale: float = 1.0) -> None:
        self.kind, self.seed, self.scale = kind, seed, scale
        self.drawn = 0
        self.pieces: list[tuple[np.ndarray, ...]] = []
        self.materials: list[np.ndarray] = []
        self.nodes: list[AnnotatedNode] = []
        self.background: list[int] = []

    def draw(self, name: str, kind: str | None = None) -> ObjectModel:
        """Draw the next object from the classes of a kind of scene, by default of this scene's kind.

        The object's appearance depends on the seed and the number of objects drawn so far.
        """
        self.drawn += 1
        return build_object(kind or self.kind, name, np.random.default_rng([self.seed, 22, self.drawn]))

    def add_object(
        self, model: ObjectModel, scale: float, xy: np.ndarray, yaw_deg: float, base_z: float = 0.0
    ) -> int:
        """Scale, rotate and move an object, add it, and return the id of its whole."""
        first, materials = len(self.nodes), sum(len(rows) for rows in self.materials)
        for row, node in enumerate(model.nodes):
            parent = NONE if node.parent == NONE else first + node.parent
            self.nodes.append(AnnotatedNode(first + row, node.level, parent, node.text, node.synonyms))
        rotation = rotation_about("z", yaw_deg)
        local = model.triangles * scale
        triangles = local @ rotation.T + np.array([xy[0], xy[1], base_z])
        node_ids = np.where(model.node_ids == NONE, NONE, model.node_ids + first)
        mesh = (triangles, model.normals @ rotation.T, local / self.scale)
        self.pieces.append((*mesh, node_ids, model.material_ids + materials))
        self.materials.append(model.materials)
        return first

    def add_surroundings(
        self, text: str, synonyms: tuple[str, ...], pieces: list[tuple[Mesh, Paint]]
    ) -> None:
        """Add a whole without parts, such as the floor, to the background."""
        node = len(self.nodes)
        self.background.append(node)
        self.nodes.append(AnnotatedNode(node, 1, NONE, text, synonyms))
        for mesh, paint in pieces:
            node_ids = np.tile(np.array([node, NONE, NONE], np.int32), (len(mesh), 1))
            material_ids = np.full(len(mesh), sum(len(rows) for rows in self.materials), np.int32)
            coords = mesh.triangles / self.scale
            self.pieces.append((mesh.triangles, mesh.normals, coords, node_ids, material_ids))
            self.materials.append(paint.row()[None])

    def finished(self, asked: int, placed: Sequence[PlacedObject], style: Style) -> WorldScene:
        """Return the scene with everything added so far."""
        columns = [np.concatenate(column) for column in zip(*self.pieces, strict=True)]
        triangles, normals, coords = (column.astype(np.float32) for column in columns[:3])
        node_ids, material_ids = (column.astype(np.int32) for column in columns[3:])
        materials = np.concatenate(self.materials).astype(np.float32)
        arrays = (triangles, normals, coords, node_ids, material_ids, materials)
        nodes, background = tuple(self.nodes), frozenset(self.background)
        return WorldScene(self.kind, self.seed, asked, tuple(placed), *arrays, nodes, background, style)


def footprint_of(triangles: Float[np.ndarray, "F 3 3"]) -> tuple[Float[np.ndarray, " 2"], float]:
    """Return the centre and radius of a circle that encloses the triangles in the x-y plane."""
    points = triangles.reshape(-1, 3)[:, :2]
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())
