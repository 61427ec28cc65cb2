"""Choose nodes of the semantic tree by their scores: a level, several hits, a path with fall-backs."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.language.relevancy import min_max
from hilsplat.language.semantic_tree import SemanticTree

CHILD_BONUS = 0.1
"""By how much what lies inside the answer before is ahead of other parts of the path's first thing: a share
of the range of the level's margins."""


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
    added: Float64[np.ndarray, " n"] | None = None,
) -> NodeHits:
    """Candidates above the threshold of their own range, best first; of equals the lowest row.

    The range is that of the cosine margins behind the relevancies. Relevancies saturate: where a dozen
    nodes score between 0.9 and 0.99, all of them are near the top of a range that reaches down to 0.1.

    Args:
        scores: relevancy of every node.
        candidates: nodes that compete.
        level: theirs.
        threshold: share of their range.
        route: as in `NodeHits`.
        added: to the margin of every node; None: nothing.
    """
    if not len(candidates):
        return NodeHits(np.zeros(0, np.int64), np.zeros(0, np.float32), level, route)
    value = margins(scores[candidates])
    if added is not None:
        value = value + added[candidates]
    kept = min_max(value) >= threshold
    chosen, value = candidates[kept], value[kept]
    chosen = chosen[np.lexsort((chosen, -value))].astype(np.int64)
    return NodeHits(chosen, scores[chosen].astype(np.float32), level, route)


def margins(scores: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Cosine margins behind relevancies, times their scale: the logistic function undone."""
    probability = np.clip(scores.astype(np.float64), 1e-7, 1 - 1e-7)
    return np.log(probability / (1 - probability))


def ancestor_margins(tree: SemanticTree, scores: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Mean margin of each node's ancestors: a knob of what answers to "kettle knob" is more likely meant.

    A node without an ancestor gets the least margin of all, a whole 0: wholes have none and only compete with
    each other. The share that is taken of it was chosen on development scenes (docs/tree.md).
    """
    margin = margins(scores)
    total, count = np.zeros(len(tree)), np.zeros(len(tree))
    above = tree.parent.astype(np.int64)
    while (above != NONE).any():
        has = above != NONE
        total[has] += margin[above[has]]
        count[has] += 1
        above[has] = tree.parent[above[has]]
    mean = np.where(count > 0, total / np.maximum(count, 1), margin.min(initial=0.0))
    return np.where(tree.level == int(Level.WHOLE), 0.0, mean)


def automatic_level(tree: SemanticTree, scores: Float[np.ndarray, " n"]) -> Level:
    """Level that a text most likely means: that of the best node; of equally good ones the coarsest.

    LangSplat's rule, asked of nodes instead of pixels. A node's vector is an average over views, and a
    level has tens of nodes: noise does not lift the finest level above the others, as it does with the
    highest of 100,000 pixels. Rules that climb to the parent of the best node, that standardise each
    level's scores or that ask siblings were all worse on development scenes (docs/tree.md).
    """
    if not len(tree):
        return Level.WHOLE
    return Level(int(tree.level[scores == scores.max()].min()))


def search_path(
    tree: SemanticTree,
    scores: Float[np.ndarray, "T n"],
    path: tuple[str, ...],
    threshold: float,
    level: Level | None = None,
) -> NodeHits:
    """Search each text inside the nodes that answered the one before: ("bear", "head", "nose").

    Each text is searched at a finer level than the one before, among the descendants of the first text's
    nodes, where descendants of the last answer are a little ahead; where there are none, in the whole level.
    Children of the last answer alone would lose what hangs under the wrong part, or under none
    (docs/tree.md).

    A path shorter than there are levels leaves open which levels it means: a handle of a mug may be a part
    or a subpart, and the head of ("head", "nose") is no whole. All ways through the levels are searched.
    Those that never had to search a whole level come first, and of these the one with the largest sum of
    margins.

    Args:
        tree: nodes.
        scores: relevancy of every node to each text of the path.
        path: the texts, coarse to fine.
        threshold: as in `best_nodes`.
        level: of the last text; None: any that the path leaves room for.

    Raises:
        SettingsError: the path is empty or longer than the levels down to the last text's.
    """
    ways = [way for way in combinations(LEVELS, len(path)) if way and level in (None, way[-1])]
    if not ways:
        levels = LEVELS if level is None else LEVELS[: level.index + 1]
        raise SettingsError(
            f"the path {' > '.join(path)!r} cannot be searched"
            + ("" if level is None else f" at level {level.label}"),
            expected=f"1 to {len(levels)} texts, coarse to fine: {' > '.join(each.label for each in levels)}",
            found=f"{len(path)}",
            fix="name the object, then its part, then the part of the part",
        )
    found = [_search_way(tree, scores, way, threshold) for way in ways]
    return max(found, key=lambda way: (way.stayed_inside, way.margin)).hits


@dataclass(frozen=True)
class _Way:
    """What a path found at certain levels.

    Attributes:
        hits: answers to the last text.
        margin: sum of the margins of each text's best answer.
        stayed_inside: every text had an answer, those behind the first inside the first thing.
    """

    hits: NodeHits
    margin: float
    stayed_inside: bool


def _search_way(
    tree: SemanticTree, scores: Float[np.ndarray, "T n"], levels: tuple[Level, ...], threshold: float
) -> _Way:
    """Search the i-th text at the i-th of some levels."""
    hits = first = best_nodes(scores[0], tree.nodes_of(levels[0]), levels[0], threshold)
    steps = [hits]
    for of_text, level in zip(scores[1:], levels[1:], strict=True):
        nodes = tree.nodes_of(level)
        ahead = np.intersect1d(nodes, tree.descendants_of(hits.ids))
        inside = np.union1d(ahead, np.intersect1d(nodes, tree.descendants_of(first.ids)))
        if len(inside):
            chosen = _best_inside(of_text, nodes, inside, ahead, threshold)
            route = "child" if tree.parent[chosen[0]] in hits.ids else "descendant"
            hits = NodeHits(chosen, of_text[chosen].astype(np.float32), level, route)
        else:
            hits = best_nodes(of_text, nodes, level, threshold, "fallback")
        steps.append(hits)
    margin = sum(float(margins(step.scores[:1]).sum()) for step in steps)
    return _Way(hits, margin, all(len(step.ids) and step.route != "fallback" for step in steps))


def _best_inside(
    scores: Float[np.ndarray, " n"],
    nodes: Int64[np.ndarray, " l"],
    inside: Int64[np.ndarray, " c"],
    ahead: Int64[np.ndarray, " k"],
    threshold: float,
) -> Int64[np.ndarray, " h"]:
    """Best of the nodes inside the path's first thing, best first; those `ahead` are so by `CHILD_BONUS`.

    The threshold is taken on the range of the whole level: of two or three candidates the worst says nothing
    about how near the second is to the best.
    """
    step = np.ptp(margins(scores[nodes]))
    value = margins(scores[inside]) + CHILD_BONUS * step * np.isin(inside, ahead)
    kept = value >= value.max() - (1 - threshold) * step
    chosen = inside[kept]
    return chosen[np.lexsort((chosen, -value[kept]))].astype(np.int64)
