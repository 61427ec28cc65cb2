"""Score masks or class maps that a method supplies: LERF-Mask, LERF-OVS in 3D, 3D-OVS by argmax."""

import difflib
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.evaluate.metrics.masks import boundary_iou, exceeds, iou
from hilsplat.evaluate.metrics.pixel_classes import argmax_masks, pixel_accuracy
from hilsplat.evaluate.protocols.cards import OVS_ARGMAX, ProtocolCard
from hilsplat.evaluate.protocols.measured import Measured

MASK_METRICS = {
    "iou": iou,
    "boundary_iou": boundary_iou,
    "acc_25": lambda prediction, truth: exceeds(prediction, truth, 0.25),
    "acc_50": lambda prediction, truth: exceeds(prediction, truth, 0.5),
}
"""Metrics of one mask against one region."""


def measure_masks(
    card: ProtocolCard,
    method: str,
    predictions: Mapping[str, Bool[np.ndarray, "h w"] | None],  # h = H and w = W, which is checked
    truths: Mapping[str, Bool[np.ndarray, "H W"]],
    queries: Collection[str] | None = None,
) -> Iterator[Measured]:
    """Rows of one view, one per text of the truth and metric.

    Args:
        card: such as `lerf-mask/gaussian-grouping`; decides the metrics and what a missing prediction counts.
        method: what made the masks.
        predictions: mask per text, at the size of the truth; a text that is absent or None has no
            prediction. Texts that the truth of this view lacks are ignored.
        truths: true region per text.
        queries: all texts asked in any view of the scene; a prediction for another text is refused, because
            a misspelt text would silently count 0. None skips the check.

    Raises:
        MisalignedArtifactError: a prediction differs in size from its truth, or is for an unknown query.
    """
    for text in predictions:
        if queries is not None and text not in queries:
            near = difflib.get_close_matches(text, list(queries), n=1)
            raise MisalignedArtifactError(
                f"there is a prediction for {text!r}, which is not a query of this scene",
                expected=f"one of {', '.join(sorted(queries))}",
                found=text,
                fix=f"rename it {near[0]!r}" if near else "remove it, or correct its name",
            )
    for text, truth in truths.items():
        prediction = predictions.get(text)
        if prediction is None:
            if card.missing == "left out":
                continue
            prediction = np.zeros_like(truth)
        _require_same_size(text, prediction.shape, truth.shape)
        for metric in card.metrics:
            value = MASK_METRICS[metric](prediction, truth)
            yield Measured(method, text, "", metric, card.full_name, value)


def measure_class_maps(
    method: str,
    similarity: Float[np.ndarray, "k h w"] | None,  # of the truth's shape, which is checked
    truth: Bool[np.ndarray, "K H W"],
    texts: Sequence[str],
) -> Iterator[Measured]:
    """Rows of one view under `3d-ovs/argmax`: the IoU of each class, the accuracy of the pixels.

    Args:
        method: what made the maps.
        similarity: cosine of each pixel with each text; None if the view has no prediction.
        truth: one mask per text.
        texts: sorted, because ties go to the first.

    Raises:
        MisalignedArtifactError: maps and truth differ in size or number.
    """
    if similarity is None:
        prediction = np.zeros_like(truth)
    else:
        _require_same_size("the class maps", similarity.shape, truth.shape)
        prediction = argmax_masks(similarity)
    protocol = OVS_ARGMAX.full_name
    for row, text in enumerate(texts):
        yield Measured(method, text, "", "iou", protocol, iou(prediction[row], truth[row]))
    accuracy = 0.0 if similarity is None else pixel_accuracy(prediction, truth)
    yield Measured(method, "", "", "pixel_accuracy", protocol, accuracy, truth[0].size)


def _require_same_size(what: str, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        raise MisalignedArtifactError(
            f"prediction and truth of {what} differ in size",
            expected=" x ".join(map(str, expected)),
            found=" x ".join(map(str, found)),
            fix="resize the prediction to the labels by the nearest pixel",
        )
