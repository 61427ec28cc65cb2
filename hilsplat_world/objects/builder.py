"""Construction of a synthetic object as a ground-truth tree of whole, parts and subparts."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int32

from hilsplat.base.levels import NONE
from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat_world.paints import COLOURS, Paint, PaintBox, difference
from hilsplat_world.shapes import Mesh, joined

Word = TypeVar("Word")

PARENT_CONTRAST = 24.0  # minimum distance in L*a*b* between a subpart and its part
NEIGHBOUR_CONTRAST = 11.0  # minimum distance in L*a*b* between other adjacent parts and subparts of an object
CORNERS = ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0))  # signs of x and y, for legs and wheels

_SHADES = (1.0, 0.85, 1.15, 0.72, 1.3, 0.6, 1.45, 0.5, 1.6)
_TOUCH = 0.03  # maximum gap between touching boxes, relative to the object's size


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One object in its own frame, with its lowest point at z = 0 and its front towards +x."""

    name: str
    nodes: tuple[AnnotatedNode, ...]  # tree, with ids and parents as rows; row 0 is the whole
    triangles: Float[np.ndarray, "F 3 3"]  # corner positions
    normals: Float[np.ndarray, "F 3 3"]  # shading normals at the corners
    node_ids: Int32[np.ndarray, "F 3"]  # whole, part and subpart of each triangle; -1 for none
    material_ids: Int32[np.ndarray, " F"]  # row in `materials` for each triangle
    materials: Float[np.ndarray, "M 14"]  # shader parameters (`Paint.row`)


class Node(NamedTuple):
    """A node of an unfinished object."""

    builder: "Builder"
    row: int
    level: int
    parent: int
    word: str  # name without the object's name
    aliases: tuple[str, ...]
    at: str = "on"  # preposition before the parent, as in "knob on the kettle lid"

    @property
    def ids(self) -> tuple[int, int, int]:
        """Rows of the whole, part and subpart that the node is or belongs to; -1 for none."""
        return 0, *{1: (NONE, NONE), 2: (self.row, NONE), 3: (self.parent, self.row)}[self.level]

    def subpart(self, names: str, paint: Paint | str = "", *meshes: Mesh, at: str = "on") -> "Node":
        """Add a subpart and return it; for the arguments, see `Builder.part`."""
        return self.builder.added(3, self.row, names, at).put(paint, *meshes)

    def put(self, paint: Paint | str, *meshes: Mesh) -> "Node":
        """Add meshes to the node and return it; for the arguments, see `Builder.part`."""
        if meshes:
            drawn = self.builder.paint(paint) if isinstance(paint, str) else paint
            self.builder.pieces.append((self.row, joined(*meshes), drawn))
        return self


class Builder:
    """Nodes and meshes of one object while it is being drawn.

    Args:
        names: class and aliases, separated by ", ".
    """

    def __init__(self, names: str, rng: np.random.Generator) -> None:
        self.rng = rng
        self.paint = PaintBox(rng).draw
        self.nodes: list[Node] = []
        self.pieces: list[tuple[int, Mesh, Paint]] = []
        self.added(1, NONE, names)

    def paints(self, *specs: str) -> list[Paint]:
        return [self.paint(spec) for spec in specs]

    def between(self, low: float | int, high: float | int) -> float:
        return float(self.rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def part(self, names: str, paint: Paint | str = "", *meshes: Mesh) -> Node:
        """Add a part and return it.

        Args:
            names: the part's name without the object's name, and aliases, separated by ", ".
            paint: paint of the meshes; a string draws a new paint (`PaintBox.draw`).
            meshes: shape of the part itself, if any, without its subparts.
        """
        return self.added(2, 0, names).put(paint, *meshes)

    def added(self, level: int, parent: int, names: str, at: str = "on") -> Node:
        word, *aliases = names.split(", ")
        self.nodes.append(Node(self, len(self.nodes), level, parent, word, tuple(aliases), at))
        return self.nodes[-1]

    def turn(self, degrees: float | int) -> None:
        """Rotate everything added so far about the vertical axis."""
        self.pieces = [(row, mesh.turned("z", degrees), paint) for row, mesh, paint in self.pieces]

    def build(self) -> ObjectModel:
        """Return the object, with its lowest point at z = 0 and contrast between touching parts."""
        node_ids = np.array([node.ids for node in self.nodes], np.int32)
        surfaces = [_surface(mesh) for _, mesh, _ in self.pieces]
        pieces = self._contrasted(surfaces)
        paints = list(dict.fromkeys(paint for _, _, paint in pieces))
        areas: dict[int, dict[Paint, float]] = defaultdict(lambda: defaultdict(float))
        for (row, _, paint), surface in zip(pieces, surfaces, strict=True):
            for ancestor in self.nodes[row].ids:
                areas[ancestor][paint] += surface
        triangles = np.concatenate([mesh.triangles for _, mesh, _ in pieces])
        triangles[..., 2] -= triangles[..., 2].min()
        return ObjectModel(
            self.nodes[0].word,
            tuple(self._described(node, areas[node.row]) for node in self.nodes),
            triangles,
            np.concatenate([mesh.normals for _, mesh, _ in pieces]),
            np.concatenate([np.tile(node_ids[row], (len(mesh), 1)) for row, mesh, _ in pieces]),
            np.concatenate([np.full(len(mesh), paints.index(paint), np.int32) for _, mesh, paint in pieces]),
            np.stack([paint.row() for paint in paints]),
        )

    def _contrasted(self, surfaces: list[float]) -> list[tuple[int, Mesh, Paint]]:
        """Return the pieces; parts and subparts that look too similar to a neighbour are repainted.

        Nodes with the same name (four legs) form a group with a common look. Groups are processed in order of
        creation. Each group's main paint is replaced by a shade of itself, or by another colour if no shade
        suffices, so that the group differs from its parent and from earlier neighbours.
        """
        areas: dict[int, dict[Paint, float]] = defaultdict(lambda: defaultdict(float))
        corners: dict[int, list[np.ndarray]] = defaultdict(list)
        for (row, mesh, paint), surface in zip(self.pieces, surfaces, strict=True):
            areas[row][paint] += surface
            corners[row].append(mesh.triangles.reshape(-1, 3))
        boxes = {}
        for row, meshes in corners.items():
            points = np.concatenate(meshes)
            boxes[row] = np.stack([points.min(axis=0), points.max(axis=0)])
        reach = _TOUCH * float(np.ptp(np.concatenate(list(boxes.values())), axis=0).max())
        groups: dict[tuple[int, str, str], list[int]] = defaultdict(list)
        for node in self.nodes[1:]:
            if node.row in boxes:
                groups[node.level, self.nodes[node.parent].word, node.word].append(node.row)
        settled: list[tuple[list[int], Paint]] = []
        repainted: dict[tuple[int, Paint], Paint] = {}
        for rows in groups.values():
            sizes = _totals((paint, size) for row in rows for paint, size in areas[row].items())
            main = max(sizes, key=sizes.__getitem__)
            parents = {self.nodes[row].parent for row in rows}
            rivals = []
            for neighbours, paint in settled:
                if parents & set(neighbours):
                    rivals.append((paint, PARENT_CONTRAST))
                elif any(_touch(boxes[row], boxes[other], reach) for row in rows for other in neighbours):
                    rivals.append((paint, NEIGHBOUR_CONTRAST))
            contrasting = _distinct(main, rivals)
            settled.append((rows, contrasting))
            repainted |= {(row, main): contrasting for row in rows}
        return [(row, mesh, repainted.get((row, paint), paint)) for row, mesh, paint in self.pieces]

    def _described(self, node: Node, area: dict[Paint, float]) -> AnnotatedNode:
        """Return a node with its queries: the canonical name, then aliases, relations and attributes."""
        whole = self.nodes[0]
        text, others = whole.word, list(whole.aliases)
        if node.level > 1:
            text = f"{whole.word} {node.word}"
            others = [f"{whole.word} {alias}" for alias in node.aliases]
            others += [f"{name} of the {whole.word}" for name in (node.word, *node.aliases)]
            others += [f"{node.word} of the {alias}" for alias in whole.aliases]
        if node.level == 3:
            others.append(f"{node.word} {node.at} the {whole.word} {self.nodes[node.parent].word}")
        share = 0.5 if node.level == 1 else 0.6
        colour, is_coloured = _prevailing(((paint.colour, size) for paint, size in area.items()), share)
        material, is_uniform = _prevailing(((paint.adjective, size) for paint, size in area.items()), share)
        if is_coloured:
            others.append(f"{colour} {text}")
        if is_uniform and material is not None:
            others.append(f"{material} {text}")
            if is_coloured:
                others.append(f"{colour} {material} {text}")
        return AnnotatedNode(node.row, node.level, node.parent, text, tuple(dict.fromkeys(others)))


def _surface(mesh: Mesh) -> float:
    edges = mesh.triangles[:, 1:] - mesh.triangles[:, :1]
    return float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum()) / 2


def _touch(first: np.ndarray, second: np.ndarray, reach: float) -> bool:
    """Return whether two boxes (lowest and highest corner) are less than `reach` apart on every axis."""
    return bool((np.maximum(first[0], second[0]) - np.minimum(first[1], second[1]) < reach).all())


def _distinct(paint: Paint, rivals: list[tuple[Paint, float]]) -> Paint:
    """Return the least changed version of a paint that keeps the minimum distance to every rival.

    If none does, it is the one that lacks least.
    """

    def short(candidate: Paint) -> float:
        return max([0.0, *(minimum - difference(candidate, rival) for rival, minimum in rivals)])

    allowed = paint.choices or tuple(COLOURS)
    shades = (paint if factor == 1 else paint.shaded(factor) for factor in _SHADES)
    others = (paint.recoloured(word) for word in allowed if word != paint.colour)
    best, least = paint, np.inf
    for candidate in chain((shade for shade in shades if shade.colour in allowed), others):
        if (lack := short(candidate)) < least:
            best, least = candidate, lack
        if least == 0:
            break
    return best


def _totals(sizes: Iterable[tuple[Word, float]]) -> dict[Word, float]:
    totals: dict[Word, float] = defaultdict(float)
    for word, size in sizes:
        totals[word] += size
    return totals


def _prevailing(sizes: Iterable[tuple[Word, float]], share: float) -> tuple[Word, bool]:
    """Return the word for most of a surface, and whether it covers at least `share` of the surface."""
    totals = _totals(sizes)
    word = max(totals, key=totals.__getitem__)
    return word, totals[word] >= share * sum(totals.values())
