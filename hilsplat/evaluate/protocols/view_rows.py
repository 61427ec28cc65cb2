"""Rows of one answer in one view."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool

from hilsplat.evaluate.metrics.localization import hits_a_box, hits_the_mask
from hilsplat.evaluate.metrics.masks import boundary_iou, iou
from hilsplat.evaluate.protocols.cards import LERF_LANGSPLAT
from hilsplat.evaluate.protocols.measured import Measured
from hilsplat.evaluate.protocols.view_truth import Query


def mask_rows(
    method: str,
    query: Query,
    protocol: str,
    mask: Bool[np.ndarray, "H W"],
    points_xy: np.ndarray,
    metrics: Sequence[str] = LERF_LANGSPLAT.metrics,
) -> Iterator[Measured]:
    """Yield IoU, boundary IoU and localization of one answer.

    Args:
        method: name of the method.
        query: the query, with its truth.
        protocol: full name, with deviating settings.
        mask: the answer.
        points_xy: pixels of the highest relevancy.
        metrics: metrics to compute.
    """
    level = query.level.label if query.level else ""
    values = {
        "iou": lambda: iou(mask, query.truth),
        "boundary_iou": lambda: boundary_iou(mask, query.truth),
        "localization_box": lambda: float(hits_a_box(points_xy, query.boxes_xyxy)),
        "localization_mask": lambda: float(hits_the_mask(points_xy, query.truth)),
    }
    for metric in metrics:
        yield Measured(method, query.text, level, metric, protocol, values[metric]())
