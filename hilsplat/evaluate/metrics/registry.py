"""Metrics allowed in rows of `scores.csv`."""

from dataclasses import dataclass
from math import isfinite


@dataclass(frozen=True)
class Metric:
    """Properties of a metric.

    Attributes:
        function: module and name of the function that computes it, under `hilsplat.evaluate.metrics`.
        symmetric: whether exchanging prediction and truth leaves it unchanged.
        bounds: smallest and largest value.
        averaging: how the values of one scene are combined, before scenes are averaged.
        perfect: value of a prediction that equals the truth; None if that depends on the truth.
        uses_truth_to_choose: whether it is a diagnostic in which the truth determines the answer.
    """

    function: str
    symmetric: bool
    bounds: tuple[float, float]
    averaging: str
    perfect: float | None = 1.0
    uses_truth_to_choose: bool = False

    @property
    def is_bounded(self) -> bool:
        """Whether both ends of the range are finite."""
        return all(map(isfinite, self.bounds))


PAIRS = "mean over (view, query) pairs, or as the protocol says"
PARENTS = "mean over views with at least one parent"
VIEWS = "mean over views"
CLASSES = "one row per class; n holds the points, so that rows of several scenes can be pooled"
POINTS = "one row per scene"
SCANS = "one row for all scans"

SHARE = (0.0, 1.0)

METRICS: dict[str, Metric] = {
    "iou": Metric("masks.iou", True, SHARE, PAIRS),
    "boundary_iou": Metric("masks.boundary_iou", True, SHARE, PAIRS),
    "acc_25": Metric("masks.exceeds", True, SHARE, PAIRS),
    "acc_50": Metric("masks.exceeds", True, SHARE, PAIRS),
    "best_threshold_iou": Metric("masks.best_threshold_iou", False, SHARE, PAIRS, uses_truth_to_choose=True),
    "localization_box": Metric("localization.hits_a_box", False, SHARE, PAIRS),
    "localization_mask": Metric("localization.hits_the_mask", False, SHARE, PAIRS),
    "pixel_accuracy": Metric("pixel_classes.pixel_accuracy", True, SHARE, VIEWS),
    "hc_containment": Metric("hierarchy.hierarchical_consistency", False, SHARE, PARENTS),
    "hc_literal": Metric("hierarchy.hierarchical_consistency", False, SHARE, PARENTS, None),
    "hc_containment_per_child": Metric("hierarchy.consistency_per_child", False, SHARE, PARENTS),
    "hc_anchored": Metric("hierarchy.hierarchical_consistency", False, SHARE, PARENTS),
    "hc_containment_pooled": Metric("hierarchy.hierarchical_consistency", False, SHARE, PARENTS),
    "hc_literal_pooled": Metric("hierarchy.hierarchical_consistency", False, SHARE, PARENTS, None),
    "hc_anchored_pooled": Metric("hierarchy.hierarchical_consistency", False, SHARE, PARENTS),
    "view_consistency": Metric("masks.iou", True, SHARE, PAIRS),
    "class_iou": Metric("point_classes.class_iou", False, SHARE, CLASSES),
    "class_accuracy": Metric("point_classes.class_accuracy", False, SHARE, CLASSES),
    "miou_present": Metric("point_classes.miou_over_present", False, SHARE, POINTS),
    "macc_present": Metric("point_classes.macc_over_present", False, SHARE, POINTS),
    "miou_occurring": Metric("point_classes.miou_over_occurring", False, SHARE, POINTS),
    "miou_head": Metric("point_classes.miou_over_occurring", False, SHARE, POINTS),
    "miou_common": Metric("point_classes.miou_over_occurring", False, SHARE, POINTS),
    "miou_tail": Metric("point_classes.miou_over_occurring", False, SHARE, POINTS),
    "miou_all": Metric("point_classes.miou_over_all", False, SHARE, POINTS, None),
    "macc_all": Metric("point_classes.macc_over_all", False, SHARE, POINTS, None),
    "miou_absent_as_one": Metric("point_classes.miou_absent_as_one", False, SHARE, POINTS),
    "frequency_weighted_iou": Metric("point_classes.frequency_weighted_iou", False, SHARE, POINTS),
    "ap": Metric("instances.ap", False, SHARE, SCANS),
    "ap50": Metric("instances.ap50", False, SHARE, SCANS),
    "ap25": Metric("instances.ap25", False, SHARE, SCANS),
    "ap_head": Metric("instances.ap", False, SHARE, SCANS),
    "ap_common": Metric("instances.ap", False, SHARE, SCANS),
    "ap_tail": Metric("instances.ap", False, SHARE, SCANS),
}
