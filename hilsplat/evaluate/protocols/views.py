"""Score a scene's answers in one view: LERF-OVS, 3D-OVS, Hi-LERF and Hi-3DOVS.

Protocols `lerf/*` query every distinct text, with its regions merged over levels; `hierarchy/*` query every
(text, level), and `hierarchy/path` every chain of texts. Protocol cards state how a method answers. A missing
or empty prediction counts as 0.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from hilsplat.base.levels import Level
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.metrics import hierarchy
from hilsplat.evaluate.metrics.masks import best_threshold_iou
from hilsplat.evaluate.metrics.relevancy_rule import (
    RelevancyRule,
    SmoothedRelevancy,
    filter_side_px,
    mean_filter,
    relevancy_mask,
    smoothing_of,
)
from hilsplat.evaluate.protocols import cards
from hilsplat.evaluate.protocols.answers import (
    NO_POINTS,
    PackedMasks,
    Selections,
    mask_rows,
    peaks_of_answer,
    relevancy_of,
)
from hilsplat.evaluate.protocols.flat_views import FlatProtocols
from hilsplat.evaluate.protocols.view_truth import Query, ViewTruth
from hilsplat.evaluate.scores import Measured
from hilsplat.settings import EvaluateSettings

RELEVANCY_CHUNK_MIB = 512
"""Memory limit for relevancy maps, which limits the texts per chunk; each chunk decodes the view again."""

MAP_RULE = ("filter_px", "mix", "relevancy_threshold", "threshold_on", "majority", "level_rule")
"""Settings that change the masks of a field: the first fields of `RelevancyRule`, in order."""

MAPS_OF_NODES = ("filter_px", "mix")
"""Settings that change localization and diagnostics of nodes, which are selected without thresholds."""

NODES = ("node_select", "ancestors")  # settings that change which nodes answer a text, or a path of one text
RELEVANCY = ("canonical", "template", "relevancy_scale")  # settings that change the relevancy itself


def rule_of(settings: EvaluateSettings) -> RelevancyRule:
    return RelevancyRule(*(getattr(settings, name) for name in MAP_RULE))


def label_of(
    card: cards.ProtocolCard, method: str, settings: EvaluateSettings, of_truth: Sequence[str] = ()
) -> str:
    """Return the protocol name of a row: the card's name and the non-default settings that affect the row.

    `of_truth` describes those that affect which regions are scored (`ViewTruth.departures`).
    """
    if method == "truth":
        return card.labelled(of_truth)
    of_method = MAP_RULE if method == "field" else (*MAPS_OF_NODES, *NODES)
    return card.labelled([*departures(settings, (*of_method, *RELEVANCY)), *of_truth])


def departures(settings: EvaluateSettings, names: Sequence[str]) -> list[str]:
    """Return descriptions of those settings whose values the cards do not state."""
    values = ((getattr(settings, name), *cards.STATED[name]) for name in names)
    return [describe(value) for value, stated, describe in values if value != stated]


def given_key(method: str, query: Query) -> tuple[Any, ...]:
    """Return the key of a method's stored answer to a query at its level."""
    return (method, cards.LEVEL_GIVEN.name, query.text, query.level)


def measure_view(
    selections: Selections,
    truth: ViewTruth,
    view: str,
    masks: PackedMasks,
    settings: EvaluateSettings,
    extra: ExtraProtocols,
) -> Iterator[Measured]:
    """Yield all rows of one view, in arbitrary order, and store the answers in `masks`."""
    answers, scene = _ViewAnswers(selections, view, settings, masks, truth), selections.scene
    words, of_nodes = [*departures(settings, RELEVANCY), *truth.departures], departures(settings, NODES)
    flat_views = FlatProtocols(scene, view, extra.flat, extra.level, words, of_nodes)
    rule = rule_of(settings)

    needs_nodes = "tree" in settings.methods or "tree-path" in settings.methods
    categories = [*truth.categories, *(truth.absent if extra.flat else ())]
    height, width = masks.size_hw
    per_chunk = max(1, int(RELEVANCY_CHUNK_MIB * 2**20 / (2 * 3 * 4 * height * width)))
    for start in range(0, len(categories), per_chunk):
        chunk = categories[start : start + per_chunk]
        texts = [category.text for category in chunk]
        fields = relevancy_of(scene, "field", texts, view) if "field" in settings.methods else None
        nodes = relevancy_of(scene, "tree", texts, view) if needs_nodes else None
        for row, category in enumerate(chunk):
            queries = [query for query in truth.queries if query.text == category.text]
            for method, maps in (("field", fields), ("tree", nodes)):
                if maps is None or method not in settings.methods:
                    continue
                mask, smooth = None, smoothing_of(maps[row])
                if category.truth.any():
                    smoothed = smooth(rule)
                    flat, answer = cards.LERF_LANGSPLAT, partial(relevancy_mask, smoothed, rule=rule)
                    if method == "tree":
                        flat, answer = cards.TREE_NODES, partial(answers.of_nodes, (category.text,))
                        yield from answers.scene_wide_rows(queries)
                        mask = answer(None)
                    yield from answers.rows(method, flat, maps[row], smoothed, answer, category, queries)
                yield from flat_views.add(method, maps[row], smooth, mask, category, queries)
            if nodes is not None and "tree-path" in settings.methods:
                yield from answers.path_rows(nodes[row], queries)
    yield from flat_views.finish()
    yield from answers.consistency_rows()


@dataclass(frozen=True)
class _ViewAnswers:
    """Rows of one view under the protocols of this module; every answer is stored in `masks`."""

    selections: Selections
    view: str
    settings: EvaluateSettings
    masks: PackedMasks
    truth: ViewTruth

    def label(self, card: cards.ProtocolCard, method: str) -> str:
        return label_of(card, method, self.settings, self.truth.departures)

    def of_nodes(self, path: tuple[str, ...], level: Level | None, *, scene_wide: bool = False) -> np.ndarray:
        """Return the mask of the nodes that answer the last text of a path."""
        ids = self.selections.nodes(path, level, None if scene_wide else self.view)
        return self.selections.mask(self.view, ids, self.masks.size_hw)

    def rows(
        self,
        method: str,
        flat: cards.ProtocolCard,
        relevancy: np.ndarray,
        smoothed: SmoothedRelevancy,
        answer: Callable[[Level | None], np.ndarray],
        category: Query,
        queries: Sequence[Query],
    ) -> Iterator[Measured]:
        """Yield a text's rows merged over levels (`category`, under protocol `flat`) and at each level.

        `answer` returns the text's mask at a level; None lets the method choose the level.
        """
        united, given, auto = (
            self.label(card, method) for card in (flat, cards.LEVEL_GIVEN, cards.LEVEL_AUTO)
        )
        auto_mask = answer(None)
        auto_points = peaks_of_answer(relevancy, smoothed.filtered, None)
        yield from mask_rows(method, category, united, auto_mask, auto_points)
        self.masks.put((method, cards.LEVEL_AUTO.name, category.text), auto_mask)
        for query in queries:
            assert query.level is not None
            given_mask = answer(query.level)
            given_points = peaks_of_answer(relevancy, smoothed.filtered, query.level)
            yield from mask_rows(method, query, given, given_mask, given_points)
            yield from mask_rows(method, query, auto, auto_mask, auto_points)
            best = best_threshold_iou(smoothed.mixed[query.level.index], query.truth)
            yield Measured(method, query.text, query.level.label, "best_threshold_iou", given, best)
            self.masks.put(given_key(method, query), given_mask)

    def scene_wide_rows(self, queries: Sequence[Query]) -> Iterator[Measured]:
        """Yield the rows of the tree's scene-wide answers, without localization, which is per view."""
        protocol = self.label(cards.SCENE_WIDE, "tree")
        for query in queries:
            mask = self.of_nodes((query.text,), query.level, scene_wide=True)
            yield from mask_rows("tree", query, protocol, mask, NO_POINTS, cards.MASK)
            self.masks.put(("tree", cards.SCENE_WIDE.name, query.text, query.level), mask)

    def path_rows(self, relevancy: np.ndarray, queries: Sequence[Query]) -> Iterator[Measured]:
        """Yield the rows of answers to paths; localization searches the parent's predicted mask, if any."""
        protocol = self.label(cards.PATH, "tree-path")
        size_hw = self.masks.size_hw
        side_px = filter_side_px(self.settings.filter_px, size_hw[0])
        for query in queries:
            assert query.level is not None
            mask = np.zeros(size_hw, dtype=bool)
            inside = np.zeros(size_hw, dtype=bool)
            for path in query.paths:
                path_mask = self.of_nodes(path, query.level)
                self.masks.put(("tree-path", cards.PATH.name, path), path_mask)
                mask |= path_mask
                if len(path) > 1:
                    is_full = len(path) == int(query.level)  # labels may lack an intermediate level
                    inside |= self.of_nodes(path[:-1], Level(len(path) - 1) if is_full else None)
            level_map = relevancy[query.level.index]
            filtered = mean_filter(np.where(inside, level_map, 0) if inside.any() else level_map, side_px)
            points = peaks_of_answer(level_map[None], filtered[None], None)
            yield from mask_rows("tree-path", query, protocol, mask, points)

    def consistency_rows(self) -> Iterator[Measured]:
        """Yield the HC of every method and the annotations; nothing for a view without parents."""
        of_methods = {
            "truth": (cards.ANNOTATIONS,),
            "field": (cards.LEVEL_AUTO, cards.LEVEL_GIVEN),
            "tree": (cards.LEVEL_AUTO, cards.LEVEL_GIVEN, cards.SCENE_WIDE),
            "tree-path": (cards.PATH,),
        }

        def mask_of(method: str, card: cards.ProtocolCard, path: tuple[str, ...]) -> np.ndarray:
            if card is cards.ANNOTATIONS:
                return self.truth.regions[path]
            if card is cards.PATH:
                return self.masks.get((method, card.name, path))
            key = path[-1:] if card is cards.LEVEL_AUTO else (path[-1], Level(len(path)))
            return self.truth.own_part(path, self.masks.get((method, card.name, *key)))

        for method, of_method in of_methods.items():
            for card in of_method if method in ("truth", *self.settings.methods) else ():
                answer = partial(mask_of, method, card)
                yield from consistency_rows(method, self.label(card, method), self.truth, answer)


def consistency_rows(
    method: str, protocol: str, truth: ViewTruth, mask_of: Callable[[tuple[str, ...]], np.ndarray]
) -> Iterator[Measured]:
    """Yield the HC of one method, which answers paths with `mask_of`; nothing if the view has no parent."""
    transitions = truth.families()
    parents = sum(map(len, transitions))
    if not parents:
        return
    families = [
        [
            hierarchy.Family(mask_of(parent), tuple(map(mask_of, children)), truth.regions[parent])
            for parent, children in transition
        ]
        for transition in transitions
    ]
    for reading in hierarchy.READINGS:
        value = hierarchy.hierarchical_consistency(families, reading)
        yield Measured(method, "", "", f"hc_{reading}", protocol, value, parents)
