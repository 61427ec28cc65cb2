"""Semantic segmentation of points: ScanNet, ScanNet200, Replica and Waymo.

Labels are 1 .. K; 0 means no class, which is ignored in the ground truth and a miss in the prediction.
Benchmarks differ in whether counts are summed per scene or over all scenes, and in which classes count.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int64


@dataclass(frozen=True)
class ClassCounts:
    """Labelled points per class: correctly predicted, in the ground truth, and predicted."""

    hits: Int64[np.ndarray, " K"]
    truth: Int64[np.ndarray, " K"]
    predicted: Int64[np.ndarray, " K"]

    @staticmethod
    def of(
        truth: Int[np.ndarray, " P"], prediction: Int[np.ndarray, " P"], num_classes: int
    ) -> "ClassCounts":
        """Count points with labels 0 .. K; predictions at points with ground truth 0 are ignored."""
        known = truth > 0
        truth, prediction = truth[known], prediction[known]

        def per_class(labels: np.ndarray) -> np.ndarray:
            counts = np.bincount(labels, minlength=num_classes + 1)[1:].astype(np.int64)
            assert len(counts) == num_classes, f"a label is above {num_classes}"
            return counts

        return ClassCounts(per_class(truth[truth == prediction]), per_class(truth), per_class(prediction))

    @property
    def union(self) -> Int64[np.ndarray, " K"]:
        """Number of points labelled or predicted as each class."""
        return self.truth + self.predicted - self.hits


def class_iou(counts: ClassCounts) -> Float[np.ndarray, " K"]:
    """Return TP / (TP + FP + FN) per class; nan if the class is in neither ground truth nor prediction."""
    return _ratio(counts.hits, counts.union)


def class_accuracy(counts: ClassCounts) -> Float[np.ndarray, " K"]:
    """Return TP / (TP + FN) per class; nan if the ground truth lacks the class."""
    return _ratio(counts.hits, counts.truth)


def miou_over_occurring(counts: ClassCounts, among: Bool[np.ndarray, " K"] | None = None) -> float:
    """Return the mean IoU over the classes in ground truth or prediction; nan if there are none.

    A class that is only predicted counts as 0. Source: ScanNet/ScanNet `evaluate_semantic_label.py`, pooled
    over all scans. `among` selects classes, such as the head, common or tail of ScanNet200.
    """
    return _mean(class_iou(counts)[(counts.union > 0) & (True if among is None else among)])


def frequency_weighted_iou(counts: ClassCounts) -> float:
    """Return the mean IoU over the ground-truth classes, weighted by their points; nan if there are none."""
    points = counts.truth.sum()
    return float(np.nan_to_num(class_iou(counts)) @ counts.truth / points) if points else float("nan")


MEANS: dict[str, Callable[[ClassCounts], float]] = {
    # Over the ground-truth classes, nan if there are none (OpenGaussian, per scene): a wrong prediction of an
    # absent class lowers only the true class's IoU.
    "miou_present": lambda counts: _mean(class_iou(counts)[counts.truth > 0]),
    "macc_present": lambda counts: _mean(class_accuracy(counts)[counts.truth > 0]),
    "miou_occurring": miou_over_occurring,
    # Over all classes; one without points (IoU) or ground truth (accuracy) counts as 0 (OpenNeRF).
    "miou_all": lambda counts: _mean(np.nan_to_num(class_iou(counts), nan=0.0)),
    "macc_all": lambda counts: _mean(np.nan_to_num(class_accuracy(counts), nan=0.0)),
    # One without points counts as 1, so that subsets that lack classes score too high: also report
    # `miou_present`. Source: waymo-research/waymo-open-dataset `metrics/segmentation_metrics.cc`.
    "miou_absent_as_one": lambda counts: _mean(np.nan_to_num(class_iou(counts), nan=1.0)),
    "frequency_weighted_iou": frequency_weighted_iou,
}
"""Metrics with one number per scene, or one number for all scenes under a pooled protocol."""


def _ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    return np.divide(numerator, denominator, out=np.full(len(numerator), np.nan), where=denominator > 0)


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")
