"""Protocols of images without levels, scored beside LangSplat's: 3D-OVS, LERF-Mask, other rules for maps.

They read the relevancy maps that `views.measure_view` renders anyway. On a stand-in with levels only the
texts of whole objects are asked, because those benchmarks do not name parts; the names of the protocols
then carry `wholes`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from hilsplat.base.levels import Level
from hilsplat.evaluate.metrics.localization import peak_points
from hilsplat.evaluate.metrics.relevancy_rule import SmoothedRelevancy, relevancy_mask
from hilsplat.evaluate.protocols.answers import ViewMaps
from hilsplat.evaluate.protocols.cards import (
    LERF_LANGSPLAT,
    LERF_MASK,
    LERF_MASK_SKIPPING,
    OVS_ARGMAX,
    ProtocolCard,
)
from hilsplat.evaluate.protocols.masks import measure_class_maps, measure_masks
from hilsplat.evaluate.protocols.measured import Measured
from hilsplat.evaluate.protocols.view_rows import mask_rows
from hilsplat.evaluate.protocols.view_truth import Query

MASKS = (LERF_MASK, LERF_MASK_SKIPPING)
EIGHTH = 8
"""3D-OVS compares at an eighth of the image's size."""


class FlatProtocols:
    """Scores one view under further protocols while its texts are answered one by one.

    Args:
        cards: protocols with a rule for maps, those of LERF-Mask, and the argmax of 3D-OVS.
        level: only texts of this level are asked; None for data without levels.
        words: what the settings change in the relevancy, for the protocols' names.
    """

    def __init__(self, cards: Sequence[ProtocolCard], level: Level | None, words: Sequence[str] = ()) -> None:
        self.cards, self.level = tuple(cards), level
        self.words = [*(["wholes"] if level is Level.WHOLE else []), *words]
        self._maps: dict[str, list[np.ndarray]] = {}
        self._truths: dict[str, Bool[np.ndarray, "h w"]] = {}

    def add(
        self,
        method: str,
        relevancy: Float32[np.ndarray, "3 H W"],
        nodes_mask: Bool[np.ndarray, "H W"] | None,
        category: Query,
        queries: Sequence[Query],
        maps: ViewMaps,
    ) -> Iterator[Measured]:
        """Rows of one text by one method.

        Args:
            method: "field" or "tree".
            relevancy: its maps.
            nodes_mask: the tree's own answer, which LERF-Mask takes; None: the map's mask.
            category: the text with all levels united.
            queries: the same per level.
            maps: what the method's maps say of further texts.
        """
        query = category if self.level is None else next((q for q in queries if q.level is self.level), None)
        if query is None:
            return
        flat = replace(query, level=None)
        for card in self.cards:
            label = card.labelled(self.words)
            if card in MASKS:
                mask = nodes_mask
                if mask is None:
                    rule = LERF_LANGSPLAT.rule
                    assert rule is not None
                    mask, _ = relevancy_mask(SmoothedRelevancy.of(relevancy, rule), None, rule)
                for row in measure_masks(card, method, {flat.text: mask}, {flat.text: flat.truth}):
                    yield replace(row, protocol=label)
            elif card.rule is not None:
                smoothed = SmoothedRelevancy.of(relevancy, card.rule)
                other = dict(card.united).get(flat.text)
                united = None if other is None else maps.relevancy((other,))[0]
                mask, _ = relevancy_mask(smoothed, None, card.rule, united)
                points, _ = peak_points(smoothed.filtered, None)
                scored = flat
                if card.truth == "any grey" and flat.any_grey is not None:
                    scored = replace(flat, truth=flat.any_grey)
                yield from mask_rows(method, scored, label, mask, points, card.metrics)
        if OVS_ARGMAX in self.cards:
            self._maps.setdefault(method, []).append(eighth(relevancy.max(axis=0)))
            self._truths[flat.text] = eighth(flat.truth.astype(np.uint8)) > 0

    def finish(self) -> Iterator[Measured]:
        """Rows that need all texts of the view: 3D-OVS by argmax, each pixel's best level."""
        texts = list(self._truths)
        if not texts:
            return
        truth = np.stack([self._truths[text] for text in texts])
        words = ["best level", *self.words]
        if self.level is not None:  # the surroundings of the objects have no text
            words = ["labelled pixels", *words]
            labelled = truth.any(axis=0)
            truth = truth[:, None, labelled]
        for method, maps in self._maps.items():
            similarity = np.stack(maps)
            if self.level is not None:
                similarity = similarity[:, None, labelled]
            if not truth.size:
                continue
            order = sorted(range(len(texts)), key=lambda row: texts[row])  # ties go to the first
            for row in measure_class_maps(
                method, similarity[order], truth[order], [texts[row] for row in order]
            ):
                yield replace(row, protocol=OVS_ARGMAX.labelled(words))


def eighth(picture: np.ndarray) -> np.ndarray:
    """A map or region at an eighth of its size, by the nearest pixel."""
    height, width = picture.shape
    size = (max(1, width // EIGHTH), max(1, height // EIGHTH))
    return cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST)
