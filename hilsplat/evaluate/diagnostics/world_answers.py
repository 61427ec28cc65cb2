"""Consistency of answers on the same surface in neighbouring views, by a synthetic scene's exact geometry."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from hilsplat.base.levels import LEVELS
from hilsplat.evaluate.diagnostics.world_consistency import neighbours, shared_points
from hilsplat.evaluate.metrics.masks import iou
from hilsplat.evaluate.metrics.relevancy_rule import SmoothedRelevancy, relevancy_mask
from hilsplat.evaluate.protocols.answers import PackedMasks, Selections
from hilsplat.evaluate.protocols.cards import VIEW_CONSISTENCY
from hilsplat.evaluate.protocols.view_truth import Query, ViewTruth
from hilsplat.evaluate.protocols.views import given_key, label_of, rule_of
from hilsplat.evaluate.scores import Measured
from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.cameras import Cameras
from hilsplat.settings import EvaluateSettings
from hilsplat.world.truth import TrueMesh

METHODS = ("field", "tree")
TEXTS_PER_LEVEL = 4
"""Texts per level and view, each queried in two views."""


def measure_world_consistency(
    answers: LanguageScene,
    selections: Selections,
    truths: Mapping[str, Callable[[], ViewTruth]],
    answered: Mapping[str, PackedMasks],
    truth: Path,
    settings: EvaluateSettings,
) -> Iterator[tuple[str, Measured]]:
    """Yield the rows of `world/view-consistency`: each annotated view and its nearest neighbour.

    The IoU is that of the answers in both views, over shared surface points; `n` is the number of points in
    the union, and texts without an answer are omitted. Nothing is yielded without a ground-truth mesh (as for
    photographed scenes). `answered` contains the stored answers by view (`views.measure_view`).
    """
    if not (truth / "mesh.ply").is_file():
        return
    true = Cameras.load(truth / "cameras.npz")
    mesh = TrueMesh.load(truth / "mesh.ply")
    known = set(true.names)
    views = [view for view in answers.scene.cameras.names if view in known]
    methods = [method for method in METHODS if method in settings.methods]
    nearest = dict(neighbours(true, views, 1))
    pairs = [(view, nearest[view]) for view in truths if view in nearest]
    for number, pair in enumerate(pairs):
        here, there = (true[each] for each in pair)
        points = shared_points(here, mesh.depth(here), there, mesh.depth(there))
        queries = spread(truths[pair[0]]().queries, TEXTS_PER_LEVEL)
        mask_of = answers_of(answers, selections, answered, pair, queries, settings)
        for method in methods:
            protocol = label_of(VIEW_CONSISTENCY, method, settings)
            for query in queries:
                assert query.level is not None
                seen_here = mask_of(method, pair[0], query).reshape(-1)[points.pixel_a]
                seen_there = mask_of(method, pair[1], query).reshape(-1)[points.pixel_b]
                union, level = int(np.count_nonzero(seen_here | seen_there)), query.level.label
                if union:
                    value = iou(seen_here[None], seen_there[None])
                    row = Measured(method, query.text, level, "view_consistency", protocol, value, union)
                    yield pair[0], row
        for each in set(pair) - {each for later in pairs[number + 1 :] for each in later}:
            answers.forget(each)


def spread(queries: Sequence[Query], per_level: int) -> list[Query]:
    """Return at most `per_level` texts per level, evenly spaced from the largest region to the smallest."""
    chosen = []
    for level in LEVELS:
        same = [query for query in queries if query.level is level]
        same.sort(key=lambda query: (-int(np.count_nonzero(query.truth)), query.text))
        count = min(per_level, len(same))
        chosen += [same[number * len(same) // count] for number in range(count)]
    return chosen


def answers_of(
    answers: LanguageScene,
    selections: Selections,
    answered: Mapping[str, PackedMasks],
    pair: tuple[str, str],
    queries: Sequence[Query],
    settings: EvaluateSettings,
) -> Callable[[str, str, Query], Bool[np.ndarray, "H W"]]:
    """Return a function from (method, view, query) to the answer at its level; stored answers are reused."""

    def is_kept(view: str, query: Query) -> bool:
        return view in answered and given_key("field", query, settings) in answered[view]

    rule = rule_of(settings)
    maps: dict[str, dict[str, np.ndarray]] = {}
    for view in pair if "field" in settings.methods else ():
        missing = [query.text for query in queries if not is_kept(view, query)]
        if missing:
            texts = list(dict.fromkeys(missing))
            maps[view] = dict(zip(texts, answers.field_relevancy(texts, view), strict=True))

    def mask_of(method: str, view: str, query: Query) -> Bool[np.ndarray, "H W"]:
        if method == "tree":
            size_hw = answers.scene.cameras[view].size_hw
            return selections.mask(view, selections.nodes((query.text,), query.level, view), size_hw)
        if is_kept(view, query):
            return answered[view].get(given_key(method, query, settings))
        smoothed = SmoothedRelevancy.of(maps[view][query.text], rule)
        return relevancy_mask(smoothed, query.level, rule)[0]

    return mask_of
