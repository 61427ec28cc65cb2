"""How an object of the synthetic world is put together: a true tree of whole, parts and subparts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int32

from hilsplat.base.levels import NONE
from hilsplat.world.paints import Paint, PaintBox
from hilsplat.world.shapes import Mesh, joined


@dataclass(frozen=True)
class ModelNode:
    """A whole, part or subpart of one object.

    Attributes:
        level: 1 whole, 2 part, 3 subpart.
        parent: row of the node one level up in the object, -1 for the whole.
        text: the query that it answers, such as "bear head".
        synonyms: other texts that name it.
        colour: word for its prevailing colour.
    """

    level: int
    parent: int
    text: str
    synonyms: tuple[str, ...]
    colour: str


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One object in its own frame: it stands on z = 0, its front faces +x.

    Attributes:
        name: class, such as "bear".
        nodes: its tree; row 0 is the whole.
        triangles: corner positions.
        normals: shading normals at the corners.
        node_ids: rows of `nodes` that a triangle belongs to (whole, part, subpart; -1 none).
        material_ids: rows of `materials`.
        materials: numbers for the shader, `Paint.row`.
    """

    name: str
    nodes: tuple[ModelNode, ...]
    triangles: Float[np.ndarray, "F 3 3"]
    normals: Float[np.ndarray, "F 3 3"]
    node_ids: Int32[np.ndarray, "F 3"]
    material_ids: Int32[np.ndarray, " F"]
    materials: Float[np.ndarray, "M 14"]


class Builder:
    """Collects the nodes and meshes of one object while its maker runs."""

    def __init__(self, name: str, aliases: tuple[str, ...], rng: np.random.Generator) -> None:
        self.name, self.aliases, self.rng = name, aliases, rng
        self.paints = PaintBox(rng)
        self._nodes: list[tuple[int, int, str, tuple[str, ...]]] = [(1, NONE, name, aliases)]
        self._pieces: list[tuple[int, Mesh, Paint]] = []

    def between(self, low: float | int, high: float | int) -> float:
        """A random size."""
        return float(self.rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        """A random choice."""
        return bool(self.rng.random() < probability)

    def part(self, word: str, *aliases: str) -> int:
        """A new part of the object; `word` is its name without the object's."""
        self._nodes.append((2, 0, word, aliases))
        return len(self._nodes) - 1

    def subpart(self, part: int, word: str, *aliases: str) -> int:
        """A new subpart of a part."""
        self._nodes.append((3, part, word, aliases))
        return len(self._nodes) - 1

    def put(self, node: int, paint: Paint, *meshes: Mesh) -> None:
        """Add meshes that belong to a part or subpart."""
        self._pieces.append((node, joined(*meshes), paint))

    def build(self) -> ObjectModel:
        paints = list(dict.fromkeys(paint for _, _, paint in self._pieces))
        triples = []
        for level, parent, _, _ in self._nodes:
            row = len(triples)
            triples.append(
                (0, NONE, NONE) if level == 1 else (0, row, NONE) if level == 2 else (0, parent, row)
            )
        area = {}  # of each paint on each node, to know what colour a node has
        for node, mesh, paint in self._pieces:
            edges = mesh.triangles[:, 1:] - mesh.triangles[:, :1]
            surface = float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum())
            for owner in triples[node]:
                if owner != NONE:
                    per_paint = area.setdefault(owner, {})
                    per_paint[paint] = per_paint.get(paint, 0.0) + surface
        triangles = np.concatenate([mesh.triangles for _, mesh, _ in self._pieces])
        triangles[..., 2] -= triangles[..., 2].min()
        return ObjectModel(
            self.name,
            tuple(self._named(row, max(area[row], key=area[row].get)) for row in range(len(self._nodes))),
            triangles,
            np.concatenate([mesh.normals for _, mesh, _ in self._pieces]),
            np.concatenate(
                [np.tile(np.int32(triples[node]), (len(mesh), 1)) for node, mesh, _ in self._pieces]
            ),
            np.concatenate(
                [np.full(len(mesh), paints.index(paint), np.int32) for _, mesh, paint in self._pieces]
            ),
            np.stack([paint.row() for paint in paints]),
        )

    def _named(self, row: int, paint: Paint) -> ModelNode:
        """Texts of a node: its canonical name, then aliases, attributes and relations."""
        level, parent, word, aliases = self._nodes[row]
        if level == 1:
            text, others = self.name, [*self.aliases]
        else:
            text = f"{self.name} {word}"
            others = [f"{self.name} {alias}" for alias in aliases]
            others += [f"{name} of the {self.name}" for name in (word, *aliases)]
            others += [f"{word} of the {alias}" for alias in self.aliases]
            if level == 3:
                others.append(f"{word} on the {self.name} {self._nodes[parent][2]}")
        others.append(f"{paint.colour} {text}")
        if paint.adjective:
            others.append(f"{paint.adjective} {text}")
        return ModelNode(level, parent, text, tuple(dict.fromkeys(others)), paint.colour)


class Maker(NamedTuple):
    """How objects of a class are drawn.

    Attributes:
        draw: adds parts, subparts and meshes to a builder; sizes and paints are random.
        aliases: other names of the class.
    """

    draw: Callable[[Builder], None]
    aliases: tuple[str, ...]
