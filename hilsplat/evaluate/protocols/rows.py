"""Rows of one answer in one view."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from hilsplat.evaluate.metrics.localization import hits_a_box, hits_the_mask
from hilsplat.evaluate.metrics.masks import argmax_masks, boundary_iou, exceeds, iou, pixel_accuracy
from hilsplat.evaluate.protocols.cards import LERF_LANGSPLAT
from hilsplat.evaluate.protocols.view_truth import Query
from hilsplat.evaluate.scores import Measured

NO_POINTS = np.zeros((0, 2), np.int64)
"""Peaks of answers without localization."""


def mask_rows(
    method: str,
    query: Query,
    protocol: str,
    mask: Bool[np.ndarray, "H W"],
    points_xy: Int[np.ndarray, "P 2"] = NO_POINTS,
    metrics: Sequence[str] = LERF_LANGSPLAT.metrics,
) -> Iterator[Measured]:
    """Yield the rows of one mask, one per metric.

    Args:
        protocol: full name, with deviating settings.
        points_xy: pixels of the highest relevancy, for localization.
    """
    level = query.level.label if query.level else ""
    values = {
        "iou": lambda: iou(mask, query.truth),
        "boundary_iou": lambda: boundary_iou(mask, query.truth),
        "acc_25": lambda: exceeds(mask, query.truth, 0.25),
        "acc_50": lambda: exceeds(mask, query.truth, 0.5),
        "localization_box": lambda: float(hits_a_box(points_xy, query.boxes_xyxy)),
        "localization_mask": lambda: float(hits_the_mask(points_xy, query.truth)),
    }
    for metric in metrics:
        yield Measured(method, query.text, level, metric, protocol, values[metric]())


def class_map_rows(
    method: str,
    protocol: str,
    similarity: Float[np.ndarray, "K H W"],
    truth: Bool[np.ndarray, "K H W"],
    texts: Sequence[str],
) -> Iterator[Measured]:
    """Yield the rows of one view under `3d-ovs/argmax`: IoU of each class and pixel accuracy.

    Args:
        similarity: cosine of each pixel with each text.
        texts: sorted, because the first wins ties.
    """
    prediction = argmax_masks(similarity)
    for row, text in enumerate(texts):
        yield Measured(method, text, "", "iou", protocol, iou(prediction[row], truth[row]))
    accuracy = pixel_accuracy(prediction, truth)
    yield Measured(method, "", "", "pixel_accuracy", protocol, accuracy, truth[0].size)
