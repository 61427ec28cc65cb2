"""Choose nodes of the semantic tree by their scores: a level, several hits, a path with fall-backs."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.language.relevancy import min_max
from hilsplat.language.semantic_tree import SemanticTree

CHILD_BONUS = 0.1
"""By how much a child of the answer before is ahead of other parts of the path's first thing: a share of the
range of the level's margins."""


@dataclass(frozen=True)
class NodeHits:
    """Nodes that answer a text.

    Attributes:
        ids: rows of the semantic tree, best first.
        scores: their relevancies.
        level: the level that was searched.
        route: how the best was reached: "flat", or on a path "child", "descendant" or "fallback" (the
            whole level, as the nodes before hold nothing there).
    """

    ids: Int64[np.ndarray, " n"]
    scores: Float32[np.ndarray, " n"]
    level: Level
    route: str = "flat"


def best_nodes(
    scores: Float[np.ndarray, " n"],
    candidates: Int64[np.ndarray, " c"],
    level: Level,
    threshold: float,
    route: str = "flat",
) -> NodeHits:
    """Candidates above the threshold of their own range, best first; of equals the lowest row.

    The range is that of the cosine margins behind the relevancies. Relevancies saturate: where a dozen
    nodes score between 0.9 and 0.99, all of them are near the top of a range that reaches down to 0.1.
    """
    if not len(candidates):
        return NodeHits(np.zeros(0, np.int64), np.zeros(0, np.float32), level, route)
    chosen = candidates[min_max(margins(scores[candidates])) >= threshold]
    order = np.lexsort((chosen, -scores[chosen]))
    return NodeHits(chosen[order].astype(np.int64), scores[chosen][order].astype(np.float32), level, route)


def margins(scores: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Cosine margins behind relevancies, times their scale: the logistic function undone."""
    probability = np.clip(scores.astype(np.float64), 1e-7, 1 - 1e-7)
    return np.log(probability / (1 - probability))


def automatic_level(
    tree: SemanticTree, scores: Float[np.ndarray, " n"], within: Int64[np.ndarray, " c"] | None = None
) -> Level:
    """Level that a text most likely means: that of the best node; of equally good ones the coarsest.

    LangSplat's rule, asked of nodes instead of pixels. A node's vector is an average over views, and a
    level has tens of nodes: noise does not lift the finest level above the others, as it does with the
    highest of 100,000 pixels. Rules that climb to the parent of the best node, that standardise each
    level's scores or that ask siblings were all worse on development scenes (docs/tree.md).
    """
    candidates = np.arange(len(tree)) if within is None else np.asarray(within)
    if not len(candidates):
        return Level.WHOLE
    best = candidates[scores[candidates] == scores[candidates].max()]
    return Level(int(tree.level[best].min()))


def search_path(
    tree: SemanticTree, scores: Float[np.ndarray, "T n"], path: tuple[str, ...], threshold: float
) -> NodeHits:
    """Search each text inside the nodes that answered the one before: ("bear", "head", "nose").

    The i-th text is searched at the i-th level among the descendants of the first text's nodes, where
    children of the last answer are a little ahead; where there are none, in the whole level. Children alone
    would lose what hangs under the wrong part, or under none (docs/tree.md).

    Args:
        tree: nodes.
        scores: relevancy of every node to each text of the path.
        path: the texts, coarse to fine.
        threshold: as in `best_nodes`.

    Raises:
        SettingsError: the path is empty or longer than there are levels.
    """
    if not 1 <= len(path) <= len(LEVELS):
        raise SettingsError(
            f"the path {' > '.join(path)!r} cannot be searched",
            expected=f"1 to {len(LEVELS)} texts, coarse to fine",
            found=f"{len(path)}",
            fix="name the object, then its part, then the part of the part",
        )
    hits = first = best_nodes(scores[0], tree.nodes_of(LEVELS[0]), LEVELS[0], threshold)
    for index, level in enumerate(LEVELS[1 : len(path)], start=1):
        nodes = tree.nodes_of(level)
        children = np.intersect1d(nodes, tree.children_of(hits.ids))
        inside = np.union1d(children, np.intersect1d(nodes, tree.descendants_of(first.ids)))
        if len(inside):
            hits = _best_inside(scores[index], nodes, inside, children, level, threshold)
        else:
            hits = best_nodes(scores[index], nodes, level, threshold, "fallback")
    return hits


def _best_inside(
    scores: Float[np.ndarray, " n"],
    nodes: Int64[np.ndarray, " l"],
    inside: Int64[np.ndarray, " c"],
    children: Int64[np.ndarray, " k"],
    level: Level,
    threshold: float,
) -> NodeHits:
    """Best of the nodes inside the path's first thing, children of the last answer ahead by `CHILD_BONUS`.

    The threshold is taken on the range of the whole level: of two or three candidates the worst says nothing
    about how near the second is to the best.
    """
    step = np.ptp(margins(scores[nodes]))
    value = margins(scores[inside]) + CHILD_BONUS * step * np.isin(inside, children)
    kept = value >= value.max() - (1 - threshold) * step
    chosen = inside[kept]
    chosen = chosen[np.lexsort((chosen, -value[kept]))].astype(np.int64)
    route = "child" if np.isin(chosen[0], children) else "descendant"
    return NodeHits(chosen, scores[chosen].astype(np.float32), level, route)
