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

Vector = Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class Style:
    """Light and colour of a rendering.

    Lengths are in scene units, colours are linear RGB.
    """

    light_position: tuple[float, float, float] = (1.3, 1.0, 3.6)  # centre of the round area light
    light_radius: float = 0.45
    light_colour: tuple[float, float, float] = (1.0, 0.96, 0.88)  # on a surface that faces the light
    sky_colour: tuple[float, float, float] = (0.42, 0.46, 0.52)  # of the light from above
    ground_colour: tuple[float, float, float] = (0.24, 0.21, 0.18)  # of the light from below
    exposure: float = 1.15  # factor on all reflected light
    scale: float = 1.0  # relative to a tabletop; scales grain, occlusion distance and ray jitter
    shadow_reach: float = 1e9  # maximum distance of shadow casters; keeps the sky from hiding the sun

    @staticmethod
    def of(
        position: Vector, radius: float, light: Vector, sky: Vector, ground: Vector, *more: float
    ) -> "Style":
        """Return a style from arrays; `more` contains the values of the last fields."""
        centre, lamp, above, below = (tuple(array.tolist()) for array in (position, light, sky, ground))
        return Style(centre, radius, lamp, above, below, *more)


@dataclass(frozen=True)
class PlacedObject:
    """Class and position of a placed object; lengths are in scene units."""

    name: str  # class of the object
    node: int  # id of the object's whole in the scene
    centre_xy: tuple[float, float]  # centre of the footprint
    footprint: float  # radius of the enclosing circle in the x-y plane
    height: float
    yaw_deg: float  # rotation about the vertical axis; the front faces +x at 0
    base_z: float = 0.0  # height of the surface under the object


@dataclass(frozen=True, eq=False)
class WorldScene:
    """A scene as triangles with their nodes, in scene units. z is up.

    The seed and the number of requested objects determine all random choices. The surroundings (table, floor,
    wall) are labelled but never scored, because large, easy regions would raise every mean score.
    """

    kind: str
    seed: int
    asked: int  # number of requested objects
    placed: tuple[PlacedObject, ...]
    triangles: Float32[np.ndarray, "F 3 3"]  # corner positions
    normals: Float32[np.ndarray, "F 3 3"]  # shading normals at the corners
    coords: Float32[np.ndarray, "F 3 3"]  # object coordinates of the corners, for solid textures
    node_ids: Int32[np.ndarray, "F 3"]  # whole, part and subpart of each triangle; -1 for none
    material_ids: Int32[np.ndarray, " F"]  # row in `materials` for each triangle
    materials: Float32[np.ndarray, "M 14"]  # shader parameters (`Paint.row`)
    nodes: tuple[AnnotatedNode, ...]  # by id; the surroundings are wholes without parts
    background: frozenset[int]  # ids of the surroundings
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
        self.materials: list[np.ndarray] = []  # one row each
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
        first = len(self.nodes)
        for row, node in enumerate(model.nodes):
            parent = NONE if node.parent == NONE else first + node.parent
            self.nodes.append(AnnotatedNode(first + row, node.level, parent, node.text, node.synonyms))
        rotation = rotation_about("z", yaw_deg)
        local = model.triangles * scale
        triangles = local @ rotation.T + np.array([xy[0], xy[1], base_z])
        node_ids = np.where(model.node_ids == NONE, NONE, model.node_ids + first)
        mesh = (triangles, model.normals @ rotation.T, local / self.scale)
        self.pieces.append((*mesh, node_ids, model.material_ids + len(self.materials)))
        self.materials.extend(model.materials)
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
            material_ids = np.full(len(mesh), len(self.materials), np.int32)
            coords = mesh.triangles / self.scale
            self.pieces.append((mesh.triangles, mesh.normals, coords, node_ids, material_ids))
            self.materials.append(paint.row())

    def finished(self, asked: int, placed: Sequence[PlacedObject], style: Style) -> WorldScene:
        """Return the scene with everything added so far."""
        columns = [np.concatenate(column) for column in zip(*self.pieces, strict=True)]
        triangles, normals, coords = (column.astype(np.float32) for column in columns[:3])
        node_ids, material_ids = (column.astype(np.int32) for column in columns[3:])
        materials = np.stack(self.materials).astype(np.float32)
        arrays = (triangles, normals, coords, node_ids, material_ids, materials)
        nodes, background = tuple(self.nodes), frozenset(self.background)
        return WorldScene(self.kind, self.seed, asked, tuple(placed), *arrays, nodes, background, style)


def footprint_of(triangles: Float[np.ndarray, "F 3 3"]) -> tuple[Float[np.ndarray, " 2"], float]:
    """Return the centre and radius of a circle that encloses the triangles in the x-y plane."""
    points = triangles.reshape(-1, 3)[:, :2]
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())
