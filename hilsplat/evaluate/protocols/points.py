"""Score classes and instances of points: ScanNet, ScanNet200, Replica, Waymo.

Predictions per point may come from any source; `carry` brings those of Gaussians to points, and every row
names its mode.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

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
from hilsplat.evaluate.protocols.measured import Measured

MEANS: dict[str, Callable[[ClassCounts], float]] = {
    "miou_present": miou_over_present,
    "macc_present": macc_over_present,
    "miou_occurring": miou_over_occurring,
    "miou_all": miou_over_all,
    "macc_all": macc_over_all,
    "miou_absent_as_one": miou_absent_as_one,
    "frequency_weighted_iou": frequency_weighted_iou,
}
"""Metrics that give one number per scene, or one for all scenes if a protocol pools."""


def point_label(card: ProtocolCard, carried: str) -> str:
    """Protocol of a row, with how predictions came to the points."""
    return card.labelled([f"points: {carried}"])


def measure_points(
    card: ProtocolCard,
    method: str,
    truth: Int[np.ndarray, " P"],
    prediction: Int[np.ndarray, " Q"] | None,  # Q = P, which is checked
    classes: ClassSet,
    carried: str,
) -> Iterator[Measured]:
    """Rows of one scene: IoU and accuracy of each class, and the scene's means if the card has them.

    `n` of a class row is the number of points its value is a share of, so that `pooled_points` can add
    scenes up. A class that is neither in truth nor prediction has no row; without any truth there is none.

    Args:
        card: a protocol of points; its classes are `classes`.
        method: what answered.
        truth: labels 1 .. K in the order of `classes`; 0 is ignored.
        prediction: the same; 0 is a miss. None if the scene has no prediction: all 0.
        classes: what was queried.
        carried: mode of `carry.CarriedPoints`, or another way by which predictions reached the points.

    Raises:
        MisalignedArtifactError: prediction and truth have different numbers of points, or the classes
            are not the protocol's.
    """
    if card.classes != classes.name:
        raise MisalignedArtifactError(
            f"{card.full_name} is not defined on these classes", expected=card.classes, found=classes.name
        )
    if prediction is None:
        prediction = np.zeros_like(truth)
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


def pooled_points(
    card: ProtocolCard, scenes: Iterable[Sequence[Measured]], classes: ClassSet
) -> dict[str, float]:
    """The means of a pooled protocol from the class rows of all scenes.

    Args:
        card: its metrics are computed.
        scenes: rows of each scene, of one method.
        classes: what was queried.
    """
    counts = pooled(_counts_of(rows, classes) for rows in scenes)
    means = {metric: MEANS[metric](counts) for metric in card.metrics if metric in MEANS}
    if "miou_head" in card.metrics:
        for split, members in splits_of(classes).items():
            means[f"miou_{split}"] = miou_over_occurring(counts, np.array(members))
    return means


def _counts_of(rows: Sequence[Measured], classes: ClassSet) -> ClassCounts:
    """Counts from class rows. Values carry six decimals in a file: exact up to a million points per class."""
    hits, truth, union = np.zeros((3, len(classes)), dtype=np.int64)
    place = {text: row for row, text in enumerate(classes.texts)}
    for row in rows:
        if row.metric == "class_iou":
            union[place[row.query]] = row.n
            hits[place[row.query]] = round(row.value * row.n)
        elif row.metric == "class_accuracy":
            truth[place[row.query]] = row.n
    return ClassCounts(hits, truth, union - truth + hits)


def measure_instances(
    method: str, scans: Mapping[str, InstanceMatches], carried: str, card: ProtocolCard = INSTANCES
) -> Iterator[Measured]:
    """AP, AP50 and AP25 of all scans together, and AP of each split; `n` is the number of scans.

    Include scans without predictions: their instances are misses. Yields nothing if no scan has an instance
    of any class.
    """
    precisions = average_precision(list(scans.values()))
    if np.isnan(precisions).all():
        return
    values = {"ap": ap(precisions), "ap50": ap50(precisions), "ap25": ap25(precisions)}
    for split, members in splits_of(SCANNET200_INSTANCES).items():
        values[f"ap_{split}"] = ap(precisions[np.array(members)])
    for metric, value in values.items():
        yield Measured(method, "", "", metric, point_label(card, carried), value, len(scans))
