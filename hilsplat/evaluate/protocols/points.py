"""Score classes and instances of points: ScanNet, ScanNet200, Replica, Waymo.

Predictions may have any source; `carry` transfers those of Gaussians to points. Every row names the mode.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Int

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.datasets.classes.class_set import ClassSet
from hilsplat.datasets.classes.scannet200 import SCANNET200_INSTANCES, splits_of
from hilsplat.evaluate.metrics.instances import InstanceMatches, ap, ap25, ap50, average_precision
from hilsplat.evaluate.metrics.point_classes import (
    ClassCounts,
    class_accuracy,
    class_iou,
    frequency_weighted_iou,
    macc_over_all,
    macc_over_present,
    miou_absent_as_one,
    miou_over_all,
    miou_over_occurring,
    miou_over_present,
    pooled,
)
from hilsplat.evaluate.protocols.cards import INSTANCES, ProtocolCard
from hilsplat.evaluate.scores import Measured

MEANS: dict[str, Callable[[ClassCounts], float]] = {
    "miou_present": miou_over_present,
    "macc_present": macc_over_present,
    "miou_occurring": miou_over_occurring,
    "miou_all": miou_over_all,
    "macc_all": macc_over_all,
    "miou_absent_as_one": miou_absent_as_one,
    "frequency_weighted_iou": frequency_weighted_iou,
}
"""Metrics with one number per scene, or one for all scenes under a pooled protocol."""


def point_label(card: ProtocolCard, carried: str) -> str:
    """Return the protocol name of a row, including how predictions were transferred to points."""
    return card.labelled([f"points: {carried}"])


def measure_points(
    card: ProtocolCard,
    method: str,
    truth: Int[np.ndarray, " P"],
    prediction: Int[np.ndarray, " Q"],  # Q = P, checked below
    classes: ClassSet,
    carried: str,
) -> Iterator[Measured]:
    """Yield the rows of one scene: IoU and accuracy per class, and the scene's means if the card has them.

    In a class row, `n` is the number of points in the denominator, so that `pooled_points` can pool scenes.
    Classes absent from truth and prediction have no row; a scene without truth has no rows.

    Args:
        card: a point protocol; its classes are `classes`.
        truth: labels 1 .. K in the order of `classes`; 0 is ignored.
        prediction: labels as in `truth`, 0 for a miss.
        carried: mode of `carry.CarriedPoints`, or another way by which predictions reached the points.

    Raises:
        MisalignedArtifactError: prediction and truth have different numbers of points, or the classes
            are not the protocol's.
    """
    if card.classes != classes.name:
        raise MisalignedArtifactError(
            f"{card.full_name} is not defined on these classes", expected=card.classes, found=classes.name
        )
    if len(prediction) != len(truth):
        raise MisalignedArtifactError(
            "predictions do not belong to the scene's points",
            expected=f"{len(truth)} points",
            found=len(prediction),
            fix="carry the predictions to the points of the ground truth",
        )
    counts = ClassCounts.of(truth, prediction, len(classes))
    protocol = point_label(card, carried)
    for metric, values, points in (
        ("class_iou", class_iou(counts), counts.union),
        ("class_accuracy", class_accuracy(counts), counts.truth),
    ):
        for row in np.flatnonzero(points):
            yield Measured(
                method, classes.texts[row], "", metric, protocol, float(values[row]), int(points[row])
            )
    if card.averaging == "scenes" and counts.truth.any():
        for metric in filter(MEANS.__contains__, card.metrics):
            yield Measured(method, "", "", metric, protocol, MEANS[metric](counts), int(counts.truth.sum()))


def pooled_points(card: ProtocolCard, scenes: Iterable[Iterable[Any]], classes: ClassSet) -> dict[str, float]:
    """Return the means of a pooled protocol.

    Args:
        scenes: the class rows of each scene, from one method: `Measured` or named tuples of a score file.
    """
    counts = pooled(_counts_of(rows, classes) for rows in scenes)
    means = {metric: MEANS[metric](counts) for metric in card.metrics if metric in MEANS}
    if "miou_head" in card.metrics:
        for split, members in splits_of(classes).items():
            means[f"miou_{split}"] = miou_over_occurring(counts, np.array(members))
    return means


def _counts_of(rows: Iterable[Any], classes: ClassSet) -> ClassCounts:
    """Return counts from class rows, exact up to 10**6 points per class because files keep six decimals."""
    hits, truth, union = np.zeros((3, len(classes)), dtype=np.int64)
    place = {text: row for row, text in enumerate(classes.texts)}
    for row in rows:
        if row.metric == "class_iou":
            union[place[row.query]] = row.n
            hits[place[row.query]] = round(row.value * row.n)
        elif row.metric == "class_accuracy":
            truth[place[row.query]] = row.n
    return ClassCounts(hits, truth, union - truth + hits)


def measure_instances(method: str, scans: Mapping[str, InstanceMatches], carried: str) -> Iterator[Measured]:
    """Yield AP, AP50 and AP25 over all scans, and AP of each split; `n` is the number of scans.

    Scans without predictions must be included: their instances are misses. Nothing is yielded if no scan has
    an instance of any class.
    """
    precisions = average_precision(list(scans.values()))
    if np.isnan(precisions).all():
        return
    values = {"ap": ap(precisions), "ap50": ap50(precisions), "ap25": ap25(precisions)}
    for split, members in splits_of(SCANNET200_INSTANCES).items():
        values[f"ap_{split}"] = ap(precisions[np.array(members)])
    for metric, value in values.items():
        yield Measured(method, "", "", metric, point_label(INSTANCES, carried), value, len(scans))
