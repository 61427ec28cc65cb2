"""One answer to a text, for people: what was found, where, and in which views."""

from dataclasses import dataclass

import numpy as np

from hilsplat.base.levels import Level
from hilsplat.semantic_tree.boxes import OrientedBox
from hilsplat.semantic_tree.tree import SemanticTree

BEST_VIEWS = 3


@dataclass(frozen=True)
class Hit:
    """One ranked answer, for people.

    Attributes:
        node: row of the semantic tree.
        level: its level.
        score: relevancy in (0, 1); 0.5 is no better than a generic phrase.
        centroid: scene units.
        box: axis-aligned, lower and upper corner, scene units.
        oriented_box: the box along the node's own axes.
        best_views: up to three train views that show it largest.
        route: as in `NodeHits`.
    """

    node: int
    level: Level
    score: float
    centroid: tuple[float, float, float]
    box: tuple[tuple[float, float, float], tuple[float, float, float]]
    oriented_box: OrientedBox
    best_views: tuple[str, ...]
    route: str

    @staticmethod
    def of(tree: SemanticTree, node: int, score: float, route: str) -> "Hit":
        """Describe a node that answered."""
        area = tree.view_area_px[node]
        order = np.lexsort((np.arange(len(area)), -area))[:BEST_VIEWS]
        low, high = tree.box[node].tolist()
        return Hit(
            node,
            Level(int(tree.level[node])),
            score,
            tuple(tree.centroid[node].tolist()),
            (tuple(low), tuple(high)),
            OrientedBox.from_array(tree.oriented_box[node]),
            tuple(tree.view_names[row] for row in order if area[row] > 0),
            route,
        )
