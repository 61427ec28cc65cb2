"""Score masks or class maps supplied by a method: LERF-Mask, LERF-OVS in 3D, 3D-OVS by argmax."""

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
"""Metrics that compare one mask with one region."""


def measure_masks(
    card: ProtocolCard,
    method: str,
    predictions: Mapping[str, Bool[np.ndarray, "h w"] | None],  # h = H and w = W, checked below
    truths: Mapping[str, Bool[np.ndarray, "H W"]],
    queries: Collection[str] | None = None,
) -> Iterator[Measured]:
    """Yield the rows of one view, one per metric and text of the truth.

    Args:
        card: such as `lerf-mask/gaussian-grouping`; determines the metrics and how missing predictions count.
        method: name of the method.
        predictions: text -> mask of the truth's size; a text that is absent or None has no prediction. Texts
            that the truth of this view lacks are ignored.
        truths: true region per text.
        queries: all texts queried in any view of the scene; predictions for other texts raise an error,
            because a misspelt text would silently count as 0. None skips the check.

    Raises:
        MisalignedArtifactError: a prediction's size differs from its truth's, or its query is unknown.
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
    similarity: Float[np.ndarray, "k h w"] | None,  # same shape as truth, checked below
    truth: Bool[np.ndarray, "K H W"],
    texts: Sequence[str],
) -> Iterator[Measured]:
    """Yield the rows of one view under `3d-ovs/argmax`: IoU of each class and pixel accuracy.

    Args:
        method: name of the method.
        similarity: cosine of each pixel with each text; None if the view has no prediction.
        truth: one mask per text.
        texts: sorted, because the first wins ties.

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
