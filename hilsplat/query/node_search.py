"""Choose nodes of the semantic tree by their scores: a level, several hits, paths."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.semantic_tree.tree import SemanticTree

# These numbers were chosen on development scenes, with others beside them: docs/semantic_tree.md, "Asking".

ALIKE = 0.9
"""Cosine of two nodes' vectors from which on they look like things of one kind."""

ALIKE_REACH = 3.0
"""How many times as far below the best answer as others nodes may lie that look like it."""

ANCESTORS_SHARE = 0.5
"""Share of how far an ancestor's margin lies below the best of its level, in the value of a path's node."""

PLAUSIBLE = 0.25
"""What lies in a node further below the best answer to a path's first text, in shares of the range, does not
compete: a nose of what is no bear is no answer to "bear > nose"."""

WITHOUT_ANCESTOR = 0.1
"""Share of the range by which a missing ancestor counts as below the best."""


@dataclass(frozen=True)
class NodeHits:
    """Nodes that answer a text.

    Attributes:
        ids: rows of the semantic tree, best first.
        scores: their relevancies.
        level: the level that was searched.
        route: how the best was reached: "flat", or on a path "child" (it has an ancestor at the level of
            every text before, the last of them its parent), "descendant" (at some, or the last is not its
            parent) or "fallback" (at none, or nothing lies in what answers the first text).
    """

    ids: Int64[np.ndarray, " n"]
    scores: Float32[np.ndarray, " n"]
    level: Level
    route: str = "flat"


def best_nodes(
    scores: Float[np.ndarray, " n"],
    vectors: Float32[np.ndarray, "n C"],
    candidates: Int64[np.ndarray, " c"],
    level: Level,
    threshold: float,
    shown: Bool[np.ndarray, " n"] | None = None,
    added: Float64[np.ndarray, " n"] | None = None,
) -> NodeHits:
    """Candidates near the best one, and those a little further that look like it; best first, of equals the
    lowest row.

    Near is measured in the range of the cosine margins behind the relevancies. Relevancies saturate: where a
    dozen nodes score between 0.9 and 0.99, all of them are near the top of a range that reaches down to 0.1.

    Args:
        scores: relevancy of every node.
        vectors: unit vectors of every node, which tell what looks alike.
        candidates: the nodes of a level; the range is theirs.
        level: theirs.
        threshold: answers lie at most 1 - threshold of the range below the best one of those shown, and
            `ALIKE_REACH` times as far if they look like it.
        shown: which nodes may answer; None: all.
        added: to the margin of every node; None: nothing.
    """
    value = margins(scores)
    if added is not None:
        value = value + added
    may = candidates if shown is None else candidates[shown[candidates]]
    spread = np.ptp(value[candidates]) if len(candidates) else 0.0
    chosen = _near_best(value, may, vectors, (1 - threshold) * spread)
    return NodeHits(chosen, scores[chosen].astype(np.float32), level)


def _near_best(
    value: Float64[np.ndarray, " n"],
    candidates: Int64[np.ndarray, " c"],
    vectors: Float32[np.ndarray, "n C"],
    reach: float,
) -> Int64[np.ndarray, " h"]:
    """Candidates at most `reach` below the best, or `ALIKE_REACH` times that if they look like it."""
    if not len(candidates):
        return np.zeros(0, np.int64)
    own = value[candidates]
    below = own.max() - own
    alike = vectors[candidates] @ vectors[candidates[own.argmax()]] >= ALIKE
    kept = below <= np.where(alike, ALIKE_REACH, 1.0) * reach
    chosen = candidates[kept]
    return chosen[np.lexsort((chosen, below[kept]))].astype(np.int64)


def margins(scores: Float[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Cosine margins behind relevancies, times their scale: the logistic function undone."""
    probability = np.clip(scores.astype(np.float64), 1e-7, 1 - 1e-7)
    return np.log(probability / (1 - probability))


def ancestor_margins(tree: SemanticTree, scores: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Mean margin of each node's ancestors: a knob of what answers to "kettle knob" is more likely meant.

    A node without an ancestor gets the least margin of all, a whole 0: wholes have none and only compete with
    each other. The share that is taken of it was chosen on development scenes (docs/semantic_tree.md).
    """
    margin = margins(scores)
    ancestors = tree.ancestors()
    above = (ancestors != NONE) & (ancestors != np.arange(len(tree))[:, None])
    count = above.sum(axis=1)
    total = np.where(above, margin[ancestors], 0.0).sum(axis=1)
    mean = np.where(count > 0, total / np.maximum(count, 1), margin.min(initial=0.0))
    return np.where(tree.level == int(Level.WHOLE), 0.0, mean)


def automatic_level(
    tree: SemanticTree, scores: Float[np.ndarray, " n"], shown: Bool[np.ndarray, " n"] | None = None
) -> Level:
    """Level that a text most likely means: that of the best node; of equally good ones the coarsest.

    LangSplat's rule, asked of nodes instead of pixels. A node's vector is an average over views, and a
    level has tens of nodes: noise does not lift the finest level above the others, as it does with the
    highest of 100,000 pixels. Rules that climb to the parent of the best node, that standardise each
    level's scores or that ask siblings were all worse on development scenes (docs/semantic_tree.md).
    """
    levels = tree.level if shown is None else tree.level[shown]
    own = scores if shown is None else scores[shown]
    if not len(levels):
        return Level.WHOLE
    return Level(int(levels[own == own.max()].min()))


def search_path(
    tree: SemanticTree,
    scores: Float[np.ndarray, "T n"],
    vectors: Float32[np.ndarray, "n C"],
    path: tuple[str, ...],
    threshold: float,
    level: Level | None = None,
    shown: Bool[np.ndarray, " n"] | None = None,
) -> NodeHits:
    """Search a node that answers the last text and lies in what answers the texts before: ("bear", "head",
    "nose").

    Every text has a level of its own. All nodes of the last text's level compete, each together with its
    ancestors: a bear that answers to "bear" a little worse than a cushion does still has the better head and
    nose. What lies in nothing like the first text does not compete (`PLAUSIBLE`), unless that leaves none.

    A path shorter than there are levels leaves open which levels it means: a handle of a mug may be a part
    or a subpart, and the head of ("head", "nose") is no whole. All ways through the levels are searched.
    Those whose best answer has an ancestor for every text come first, and of these the one with the largest
    sum of margins.

    Args:
        tree: nodes.
        scores: relevancy of every node to each text of the path.
        vectors: as in `best_nodes`.
        path: the texts, coarse to fine.
        threshold: as in `best_nodes`; the range is that of the last text.
        level: of the last text; None: any that the path leaves room for.
        shown: which nodes may answer; ancestors need not be shown, and are compared with what is shown or
            holds something shown. None: all.

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
    margin, ancestors = margins(scores), tree.ancestors()
    found = [_search_way(tree, margin, ancestors, vectors, way, threshold, shown) for way in ways]
    best = max(found, key=lambda way: (way.complete, way.margin))
    return NodeHits(best.ids, scores[-1][best.ids].astype(np.float32), best.level, best.route)


@dataclass(frozen=True)
class _Way:
    """What a path found at certain levels.

    Attributes:
        ids: answers to the last text, best first.
        level: of the last text.
        route: as in `NodeHits`.
        margin: sum of the margins of the best answer and of its ancestors.
        complete: the best answer lies in what answers the first text, and has an ancestor for every text.
    """

    ids: Int64[np.ndarray, " h"]
    level: Level
    route: str
    margin: float
    complete: bool


def _search_way(
    tree: SemanticTree,
    margin: Float64[np.ndarray, "T n"],
    ancestors: Int32[np.ndarray, "n 3"],
    vectors: Float32[np.ndarray, "n C"],
    levels: tuple[Level, ...],
    threshold: float,
    shown: Bool[np.ndarray, " n"] | None,
) -> _Way:
    """Search the last text at the last of some levels, each text before among the ancestors at its level."""
    nodes, last = tree.nodes_of(levels[-1]), margin[-1]
    may = nodes if shown is None else nodes[shown[nodes]]
    if not len(may):
        return _Way(may, levels[-1], "fallback" if len(levels) > 1 else "flat", -np.inf, False)
    value, total = last.copy(), last.copy()
    likely = np.ones(len(tree), np.bool_)
    for text, (of_text, level) in enumerate(zip(margin[:-1], levels[:-1], strict=True)):
        holder, of_level = ancestors[:, level.index], tree.nodes_of(level)
        rivals = of_level
        if shown is not None:  # what holds something that is shown may itself be hidden behind it
            rivals = of_level[shown[of_level] | np.isin(of_level, holder[may])]
        best = of_text[rivals].max() if len(rivals) else 0.0
        spread = np.ptp(of_text[of_level]) if len(of_level) else 0.0
        below = np.where(holder != NONE, best - of_text[holder], WITHOUT_ANCESTOR * spread)
        value -= ANCESTORS_SHARE * below
        total += best - below
        if text == 0:
            likely = below <= PLAUSIBLE * spread
    inside = bool(likely[may].any())
    reach = (1 - threshold) * np.ptp(last[nodes])
    chosen = _near_best(value, may[likely[may]] if inside else may, vectors, reach)
    best_one = chosen[0]
    holders = ancestors[best_one, [level.index for level in levels[:-1]]]
    complete = inside and bool((holders != NONE).all())
    route = _route(holders, int(tree.parent[best_one]), inside)
    return _Way(chosen, levels[-1], route, float(total[best_one]), complete)


def _route(holders: Int32[np.ndarray, " a"], parent: int, inside: bool) -> str:
    """See `NodeHits`; `inside`: the best answer lies in what answers the first text."""
    if not len(holders):
        return "flat"
    if not inside or (holders == NONE).all():
        return "fallback"
    return "child" if (holders != NONE).all() and holders[-1] == parent else "descendant"
