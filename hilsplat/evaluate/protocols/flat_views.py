"""Protocols for images without levels, in addition to LangSplat's: 3D-OVS, LERF-Mask and other map rules.

On a stand-in with levels, only texts of whole objects are queried, because these benchmarks do not name
parts; the protocol names then include `wholes`.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int64

from hilsplat.base.levels import Level
from hilsplat.evaluate.metrics.masks import argmax_masks, iou, pixel_accuracy
from hilsplat.evaluate.metrics.relevancy_rule import RelevancyRule, Smooth, relevancy_mask, smoothing_of
from hilsplat.evaluate.protocols.answers import NO_POINTS, mask_rows, peaks_of_answer, relevancy_of
from hilsplat.evaluate.protocols.cards import (
    LERF_LANGSPLAT,
    LERF_MASK,
    LERF_MASK_SKIPPING,
    OVS_ARGMAX,
    OVS_NODES,
    ProtocolCard,
)
from hilsplat.evaluate.protocols.view_truth import Query, kept_by_pillow
from hilsplat.evaluate.scores import Measured

if TYPE_CHECKING:
    from hilsplat.query.language_scene import LanguageScene


Answer = Bool[np.ndarray, "_ _"] | Float[np.ndarray, "_ _ _"]
"""A mask (H, W), or relevancy (3, H, W); under `3d-ovs/argmax`, cosines (L, H, W)."""


class FlatProtocols:
    """Scores one view under additional protocols, one text at a time.

    Only texts of `level` are queried, unless the data has no levels (None). The protocol names contain
    `words`, the settings that change the relevancy, and `of_nodes`, those that change masks of nodes.
    """

    def __init__(
        self,
        scene: "LanguageScene",
        view: str,
        cards: Sequence[ProtocolCard],
        level: Level | None,
        words: Sequence[str] = (),
        of_nodes: Sequence[str] = (),
    ) -> None:
        self.scene, self.view, self.cards, self.level = scene, view, tuple(cards), level
        self.words = [*(["wholes"] if level is Level.WHOLE else []), *words]
        self.words_of_nodes = [*self.words, *of_nodes]
        self._queries: dict[str, dict[str, Query]] = {}  # by method and text, for the argmax

    def add(
        self,
        method: str,
        relevancy: Float32[np.ndarray, "3 H W"],
        smooth: Smooth,
        nodes_mask: Bool[np.ndarray, "H W"] | None,
        category: Query,
        queries: Sequence[Query],
    ) -> Iterator[Measured]:
        """Yield the rows of one text, merged over levels (`category`) or at one of its levels (`queries`).

        `smooth` returns the smoothed `relevancy` (`smoothing_of`). `nodes_mask` is the tree's mask, for
        LERF-Mask and `3d-ovs/tree-nodes`. If it is None, LERF-Mask derives the mask from the relevancy maps.
        """
        query = category if self.level is None else next((q for q in queries if q.level is self.level), None)
        if query is None:
            return
        flat = replace(query, level=None)
        for card in self.cards:
            is_of_nodes = nodes_mask is not None and card in (LERF_MASK, LERF_MASK_SKIPPING, OVS_NODES)
            if is_of_nodes:
                yield from answer_rows(method, card, flat, nodes_mask, self.words_of_nodes, card.metrics)
            elif rule_of(card) is not None:  # other protocols need nodes, or all texts (`finish`)
                other = dict(card.united).get(flat.text)
                united = relevancy_of(self.scene, method, (other,), self.view)[0] if other else None
                how = self.words, card.metrics, united, smooth
                yield from answer_rows(method, card, flat, relevancy, *how)
        if OVS_ARGMAX in self.cards:
            self._queries.setdefault(method, {})[flat.text] = flat

    def finish(self) -> Iterator[Measured]:
        """Yield the rows that need all texts of the view: 3D-OVS by argmax over texts and levels."""
        words = ["best level", *self.words]
        for method, queries in self._queries.items():
            cosine_of = functools.partial(self._cosine, method)
            yield from argmax_rows(method, list(queries.values()), cosine_of, words, self.level is not None)

    def _cosine(self, method: str, texts: Sequence[str], pixels: Int64[np.ndarray, " P"]) -> np.ndarray:
        render = self.scene.field.cosine if method == "field" else self.scene.node_cosine
        return np.asarray(render(tuple(texts), self.view, pixels), np.float32)


def rule_of(card: ProtocolCard) -> RelevancyRule | None:
    """Return the rule that makes masks from relevancy; LERF-Mask, which states none, uses LangSplat's."""
    return LERF_LANGSPLAT.rule if card in (LERF_MASK, LERF_MASK_SKIPPING) else card.rule


def mask_of(
    card: ProtocolCard,
    level: Level | None,
    answer: Answer,
    united: Answer | None = None,
    smooth: Smooth | None = None,
) -> tuple[Bool[np.ndarray, "H W"], Int[np.ndarray, "P 2"]]:
    """Return an answer's mask, made from relevancy by the protocol's rule, and the peaks of the relevancy.

    `united` is the relevancy of a second text that the protocol merges with the first, and `smooth` returns
    the answer smoothed, if the caller has that already.
    """
    rule = rule_of(card)
    if answer.ndim == 2 or rule is None:
        return answer, NO_POINTS
    smoothed = (smooth or smoothing_of(answer))(rule)
    peaks = peaks_of_answer(answer, smoothed.filtered, level)
    return relevancy_mask(smoothed, level, rule, united), peaks


def answer_rows(
    method: str,
    card: ProtocolCard,
    query: Query,
    answer: Answer | None,
    words: Sequence[str],
    metrics: Sequence[str],
    united: Answer | None = None,
    smooth: Smooth | None = None,
) -> Iterator[Measured]:
    """Yield the rows of a text's answer (see `mask_of`), or of an empty mask without an answer.

    A text has no rows if the view doesn't show it, or if it has no answer and the protocol leaves it out.
    """
    region = query.region(card.truth)
    if region.any() and not (answer is None and card.missing == "left out"):
        mask, points = np.zeros_like(region), NO_POINTS
        if answer is not None:
            mask, points = mask_of(card, query.level, answer, united, smooth)
        answered = replace(query, truth=region)
        yield from mask_rows(method, answered, card.labelled(words), mask, points, metrics)


def argmax_rows(
    method: str,
    queries: Sequence[Query],
    cosine_of: Callable[[Sequence[str], Int64[np.ndarray, " P"]], Float[np.ndarray, "K L P"]],
    words: Sequence[str],
    is_stand_in: bool,
) -> Iterator[Measured]:
    """Yield the rows of 3D-OVS by argmax at one eighth of the image's size; the first text wins ties.

    Args:
        cosine_of: cosines of texts with pixels (row * width + column), at any number of levels; -inf if none.
        words: non-default settings, for the protocol's name.
        is_stand_in: whether pixels around the objects have no text; if so, they are not compared.
    """
    if not queries:
        return
    ordered = sorted(queries, key=lambda query: query.text)
    size_hw, truth = ordered[0].truth.shape, np.stack([query.eighth for query in ordered])
    compared = truth.any(axis=0) if is_stand_in else np.full(truth.shape[1:], True)
    pixels = kept_by_pillow(size_hw, truth.shape[1:])[compared]
    if not len(pixels):
        return
    protocol = OVS_ARGMAX.labelled([*(["labelled pixels"] if is_stand_in else []), *words])
    texts = [query.text for query in ordered]
    prediction = argmax_masks(cosine_of(texts, pixels).max(axis=1)[:, None])
    truth = truth[:, None, compared]
    for row, text in enumerate(texts):
        yield Measured(method, text, "", "iou", protocol, iou(prediction[row], truth[row]))
    accuracy = pixel_accuracy(prediction, truth)
    yield Measured(method, "", "", "pixel_accuracy", protocol, accuracy, len(pixels))
