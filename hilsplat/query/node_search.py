"""Selection of semantic tree nodes by cosine margins: level, number of answers, paths."""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.semantic_tree.tree import SemanticTree

# These values were chosen on development scenes; docs/experiments.md ("Query") compares them with others.

ALIKE = 0.9  # minimum cosine of two nodes' vectors to count as similar, such as objects of the same kind

ALIKE_REACH = 3.0
"""Nodes that look like the best answer may be this many times as far below it as other nodes."""

ANCESTORS_SHARE = 0.5
"""Fraction of an ancestor's shortfall (its level's best minus its own) subtracted from a path's node."""

PLAUSIBLE = 0.25
"""A node competes on a path only if its ancestor is at most this fraction of the margin range below the best
answer to the first text: only the nose of a plausible bear is an answer to "bear > nose"."""

WITHOUT_ANCESTOR = 0.1  # shortfall assumed for a missing ancestor, as a fraction of the margin range


@dataclass(frozen=True)
class TextAnswer:
    """The best match of one text of a query.

    Attributes:
        margin: cosine margin of the best node that competed at `level`; -inf if no node competed. If it is
            not positive, the node is no closer to the text than to a canonical phrase.
        anywhere: cosine margin of the best node of any level.
        chance: share of words for absent objects whose best margin is at least as high; None if unknown.
        unknown: words of the text that are not in the model's vocabulary.
    """

    text: str
    level: Level
    margin: float
    anywhere: float
    chance: float | None = None
    unknown: tuple[str, ...] = ()


@dataclass(frozen=True)
class NodeHits:
    """Nodes that answer a text.

    Attributes:
        ids: rows of the semantic tree, best first.
        values: each node's sort key, which is its cosine margin for the last text, plus a bonus (one text) or
            minus a penalty (a path) that depends on its ancestors.
        route: how the best node was found: "flat" for one text. For a path, "child" if it has an ancestor at
            the level of every earlier text and the nearest of them is its parent; "fallback" if it has no
            such ancestor or nothing plausible matches the first text; otherwise "descendant".
        texts: the best match of each text of the query, coarse to fine.
    """

    ids: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, " n"]
    route: str
    texts: tuple[TextAnswer, ...]

    @property
    def level(self) -> Level:
        """The level that was searched for the last text."""
        return self.texts[-1].level


def search(
    tree: SemanticTree,
    margin: Float32[np.ndarray, "T n"],
    vectors: Float32[np.ndarray, "n C"],
    path: tuple[str, ...],
    *,
    threshold: float,
    ancestors: float,
    visible: Bool[np.ndarray, " n"],
    level: Level | None = None,
) -> NodeHits:
    """Find the nodes that answer a text, or the last text of a path such as ("bear", "head", "nose").

    Nodes that answer a path match its last text and are part of nodes that match the earlier texts. Every
    text has its own level. All nodes at the last text's level compete, each together with its ancestors. If a
    cushion matches "bear" slightly better than the bear does, the bear still wins, because its head and nose
    match. A node that is not part of a plausible answer to the first text (`PLAUSIBLE`) does not compete,
    unless no node is part of one.

    If a path has fewer texts than there are levels, its levels are ambiguous: the handle of a mug may be a
    part or a subpart, and the head of ("head", "nose") is not a whole. All combinations of levels are
    therefore searched. Combinations whose best answer has an ancestor for every text are preferred; among
    these, the largest sum of margins wins. Ancestors need not be visible; they compete with nodes that are
    visible or have a visible descendant.

    Args:
        margin: cosine margin of every node for each text.
        vectors: unit vectors of every node, which determine which nodes look alike.
        threshold: answers are below the best visible node by at most (1 - threshold) times the range of the
            level's values, or by `ALIKE_REACH` times that distance if they look like the best.
        ancestors: fraction of the ancestors' mean margin that is added to a node's own margin; ignored for a
            path of several texts, which itself specifies the ancestors.
        visible: which nodes are allowed as answers.
        level: level of the last text; None chooses it automatically.

    Raises:
        SettingsError: the path has more texts than levels from whole to the level of its last text.
    """
    margin = margin.astype(np.float64)
    anywhere = margin[:, visible].max(axis=1, initial=-np.inf).tolist()
    if len(path) == 1:
        (margin_of_text,) = margin
        level = automatic_level(tree, margin_of_text, visible) if level is None else level
        nodes = tree.nodes_of(level)
        candidates = nodes[visible[nodes]]
        value = margin_of_text + ancestors * ancestor_margins(tree, margin_of_text)
        spread = np.ptp(value[nodes]) if len(nodes) else 0.0
        chosen = _near_best(value, candidates, vectors, (1 - threshold) * spread)
        best = float(margin_of_text[candidates].max(initial=-np.inf))
        return NodeHits(chosen, value[chosen], "flat", (TextAnswer(path[0], level, best, *anywhere),))
    ways = [way for way in combinations(LEVELS, len(path)) if level in (None, way[-1])]
    if not ways:
        labels = [known.label for known in LEVELS if level is None or known <= level]
        at_level = "" if level is None else f" at level {level.label}"
        raise SettingsError(
            f"the path {' > '.join(path)!r} cannot be searched{at_level}",
            expected=f"1 to {len(labels)} texts, coarse to fine: {' > '.join(labels)}",
            found=f"{len(path)}",
            fix="name the object, then its part, then a part of that part",
        )
    containing = tree.ancestors()
    results = [_search_way(tree, margin, containing, vectors, way, threshold, visible) for way in ways]
    best_row = max(range(len(ways)), key=lambda row: results[row][:2])
    _, _, margins, hits = results[best_row]
    return replace(hits, texts=tuple(map(TextAnswer, path, ways[best_row], margins, anywhere)))


def _near_best(
    value: Float64[np.ndarray, " n"],
    candidates: Int64[np.ndarray, " c"],
    vectors: Float32[np.ndarray, "n C"],
    reach: float,
) -> Int64[np.ndarray, " h"]:
    """Return candidates at most `reach` below the best, or `ALIKE_REACH` times that if they look like it.

    They are sorted best first, and ties are sorted by row.
    """
    if not len(candidates):
        return np.zeros(0, np.int64)
    values = value[candidates]
    below = values.max() - values
    is_alike = vectors[candidates] @ vectors[candidates[values.argmax()]] >= ALIKE
    is_near = below <= np.where(is_alike, ALIKE_REACH, 1.0) * reach
    chosen = candidates[is_near]
    return chosen[np.lexsort((chosen, below[is_near]))].astype(np.int64)


def ancestor_margins(tree: SemanticTree, margin: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return the mean margin of each node's ancestors, since "kettle knob" likely means a knob on a kettle.

    A whole gets 0, because wholes have no ancestors and compete only with each other. Any other node without
    ancestors gets the lowest margin of all nodes. `search` adds a fraction chosen on development scenes.
    """
    ancestors = tree.ancestors()
    above = (ancestors != NONE) & (ancestors != np.arange(len(tree))[:, None])
    count = above.sum(axis=1)
    total = np.where(above, margin[ancestors], 0.0).sum(axis=1)
    mean = np.where(count > 0, total / np.maximum(count, 1), margin.min(initial=0.0))
    return np.where(tree.level == int(Level.WHOLE), 0.0, mean)


def automatic_level(
    tree: SemanticTree, margin: Float64[np.ndarray, " n"], visible: Bool[np.ndarray, " n"]
) -> Level:
    """Return the level of the visible node that best matches a text; the coarsest level wins ties.

    This is LangSplat's rule, applied to nodes instead of pixels. A node's vector is an average over views,
    and a level has tens of nodes, so noise does not favour the finest level, as it does for a maximum over
    100,000 pixels. docs/experiments.md ("Query") compares it with other rules.
    """
    if not visible.any():
        return Level.WHOLE
    levels, margin = tree.level[visible], margin[visible]
    return Level(int(levels[margin == margin.max()].min()))


def _search_way(
    tree: SemanticTree,
    margin: Float64[np.ndarray, "T n"],
    ancestors: Int32[np.ndarray, "n 3"],
    vectors: Float32[np.ndarray, "n C"],
    levels: tuple[Level, ...],
    threshold: float,
    visible: Bool[np.ndarray, " n"],
) -> tuple[bool, float, list[float], NodeHits]:
    """Search the last level for the last text, and each earlier level's ancestors for the earlier text.

    Returns:
        whether the best answer is part of a plausible answer to the first text and has an ancestor for every
        text; the sum of the margins of the best answer and its ancestors; the margin of the best node that
        competed for each text; and the answers, with `texts` unset.
    """
    nodes, last = tree.nodes_of(levels[-1]), margin[-1]
    candidates = nodes[visible[nodes]]
    value, total = last.copy(), last.copy()
    likely = np.ones(len(tree), np.bool_)
    margins = []
    for text, (of_text, level) in enumerate(zip(margin[:-1], levels[:-1], strict=True)):
        holder, of_level = ancestors[:, level.index], tree.nodes_of(level)
        # an ancestor may be hidden behind a descendant
        rivals = of_level[visible[of_level] | np.isin(of_level, holder[candidates])]
        margins.append(float(of_text[rivals].max(initial=-np.inf)))
        best = margins[-1] if len(rivals) else 0.0
        # Without 0, the margin of a tie, the range of a single object or of several that all match the text
        # would be close to 0, and the penalties would vanish.
        spread = np.ptp(np.append(of_text[of_level], 0.0))
        below = np.where(holder != NONE, best - of_text[holder], WITHOUT_ANCESTOR * spread)
        value -= ANCESTORS_SHARE * below
        total += best - below
        if text == 0:
            likely = below <= PLAUSIBLE * spread
    margins.append(float(last[candidates].max(initial=-np.inf)))
    if not len(candidates):
        return False, -np.inf, margins, NodeHits(candidates, value[candidates], "fallback", ())
    inside = bool(likely[candidates].any())
    reach = (1 - threshold) * np.ptp(last[nodes])
    chosen = _near_best(value, candidates[likely[candidates]] if inside else candidates, vectors, reach)
    holders = ancestors[chosen[0], [level.index for level in levels[:-1]]]
    complete = inside and bool((holders != NONE).all())
    route = "descendant"
    if not inside or (holders == NONE).all():
        route = "fallback"
    elif complete and holders[-1] == tree.parent[chosen[0]]:
        route = "child"
    return complete, float(total[chosen[0]]), margins, NodeHits(chosen, value[chosen], route, ())
