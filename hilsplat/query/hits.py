"""Answers as users see them: the node, its position, its best views and any doubts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest

import numpy as np
from jaxtyping import Bool, Int64

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import Level
from hilsplat.query.node_search import NodeHits
from hilsplat.query.scene_views import SceneViews, View
from hilsplat.semantic_tree.tree import OrientedBox

LIKELY_CHANCE = 0.05
"""An answer is doubtful if more than this share of the words for absent objects score at least as high."""


def checked_count(count: int, name: str = "limit") -> int:
    """Return a number of answers; raise SettingsError if it is negative or not a whole number."""
    if not isinstance(count, int | np.integer) or count < 0:  # a slice would leave out the last answers
        raise SettingsError(f"{name} is {count!r}", expected="a number of answers, at least 0")
    return int(count)


@dataclass(frozen=True)
class Doubt:
    """A query text that may match nothing in the scene.

    Attributes:
        level: the level that was searched, if a node at any level matches the text; otherwise None.
        chance: share of words for absent objects that score at least as high; None for a different doubt.
        unknown: words of the text that are not in the model's vocabulary.
    """

    text: str
    level: Level | None
    chance: float | None
    unknown: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.unknown:
            words = ", ".join(map(repr, self.unknown))
            return f"{self.text!r} may not be in the scene: the model's vocabulary lacks {words}"
        if self.chance is None:
            kind = "node" if self.level is None else self.level.label
            return f"no {kind} is closer to {self.text!r} than to a generic word"
        share = f"{self.chance:.0%} of words for absent things"
        return f"{self.text!r} may not be in the scene: {share} score as high"


@dataclass(frozen=True, repr=False)
class Node:
    """A node of a scene's tree; lengths are in scene units.

    Attributes:
        node: row of the semantic tree.
        parent: row of the coarser node that contains this one, -1 for none.
        box: lower and upper corner of the axis-aligned box.
        oriented_box: the box along the node's own axes.
        best_views: up to three training views in which the node is largest.
        name: the user's name for the node, otherwise its vocabulary name; empty if no name fits.
    """

    node: int
    level: Level
    parent: int
    centroid: tuple[float, float, float]
    box: tuple[tuple[float, float, float], tuple[float, float, float]]
    oriented_box: OrientedBox
    best_views: tuple[str, ...]
    name: str
    _views: SceneViews = field(compare=False)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.node}, {self.level.label}, {self.name!r})"

    @property
    def gaussians(self) -> Int64[np.ndarray, " g"]:
        """Rows of the node's Gaussians in `gaussians.ply`."""
        return self._views.gaussians_of([self.node])

    def mask(self, view: View) -> Bool[np.ndarray, "H W"]:
        """Return the pixels in which the node's Gaussians have more than half of the weight.

        Args:
            view: name of a view, or any camera in scene coordinates.

        Raises:
            SettingsError: the scene has no such view.
        """
        return self._views.node_masks(view, [self.node])


@dataclass(frozen=True, repr=False)
class Hit(Node):
    """One ranked answer.

    Attributes:
        score: relevancy of the node and, with a lower weight, of its ancestors, in (0, 1). Answers are sorted
            by score; at 0.5, the query fits no better than a generic word. For route "like": a cosine.
        route: as in `NodeHits`, or "like".
        doubts: texts of the query that may match nothing; all answers to the query have the same doubts.
    """

    score: float
    route: str
    doubts: tuple[Doubt, ...]

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, score {self.score:.2f})"


@dataclass(frozen=True)
class NodeGroup:
    """Named nodes in saved files: the answers to a query, or a selection.

    Attributes:
        nodes: rows of the semantic tree.
        scores: score of each node; empty if the nodes are not answers.
        doubts: doubts about the answers.
    """

    name: str
    nodes: tuple[int, ...]
    scores: tuple[float, ...] = ()
    doubts: tuple[str, ...] = ()

    @staticmethod
    def of(text: str, hits: Sequence[Hit]) -> "NodeGroup":
        """Return the answers to a query."""
        nodes, scores = tuple(hit.node for hit in hits), tuple(round(hit.score, 4) for hit in hits)
        return NodeGroup(text, nodes, scores, tuple(str(doubt) for doubt in hits[0].doubts) if hits else ())

    @property
    def score_of(self) -> dict[int, float | None]:
        """The score of each node; None if the nodes are not answers."""
        return dict(zip_longest(self.nodes, self.scores))


def label_comments(groups: Sequence[NodeGroup], name_of: Callable[[int], str]) -> list[str]:
    """Return comments for a PLY whose labels number the groups from 1: names, nodes, scores and doubts."""
    comments = []
    for number, group in enumerate(groups, 1):
        comments.append(f"label {number}: {group.name}")
        for node, score in group.score_of.items():
            named = f"label {number}, node {node}: {name_of(node) or '?'}"
            comments.append(named if score is None else f"{named}, score {score:.4f}")
        comments += [f"label {number}, doubtful: {doubt}" for doubt in group.doubts]
    return comments


def doubts_of(hits: NodeHits) -> tuple[Doubt, ...]:
    """Return a doubt for each query text that may match nothing in the scene."""
    doubts = []
    for text in hits.texts:
        is_likely = text.chance is not None and text.chance > LIKELY_CHANCE
        if text.unknown or text.margin <= 0 or is_likely:
            level = text.level if text.anywhere > 0 else None
            doubts.append(Doubt(text.text, level, text.chance if is_likely else None, text.unknown))
    return tuple(doubts)
