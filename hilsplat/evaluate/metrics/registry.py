"""Metrics allowed in rows of `scores.csv`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """Properties of a metric, whose values are in [0, 1]; its protocol determines how they are averaged.

    Attributes:
        function: module and name of the function that computes it, under `hilsplat.evaluate.metrics`.
        symmetric: whether exchanging prediction and truth leaves it unchanged.
        perfect: value of a prediction that equals the truth; None if that depends on the truth.
        uses_truth_to_choose: whether it is a diagnostic in which the truth determines the answer.
    """

    function: str
    symmetric: bool
    perfect: float | None = 1.0
    uses_truth_to_choose: bool = False


METRICS: dict[str, Metric] = {
    "iou": Metric("masks.iou", True),
    "boundary_iou": Metric("masks.boundary_iou", True),
    "acc_25": Metric("masks.exceeds", True),
    "acc_50": Metric("masks.exceeds", True),
    "best_threshold_iou": Metric("masks.best_threshold_iou", False, uses_truth_to_choose=True),
    "localization_box": Metric("localization.hits_a_box", False),
    "localization_mask": Metric("localization.hits_the_mask", False),
    "pixel_accuracy": Metric("masks.pixel_accuracy", True),
    "hc_containment": Metric("hierarchy.hierarchical_consistency", False),
    "hc_literal": Metric("hierarchy.hierarchical_consistency", False, None),
    "hc_containment_per_child": Metric("hierarchy.consistency_per_child", False),
    "hc_anchored": Metric("hierarchy.hierarchical_consistency", False),
    "hc_containment_pooled": Metric("hierarchy.hierarchical_consistency", False),
    "hc_literal_pooled": Metric("hierarchy.hierarchical_consistency", False, None),
    "hc_anchored_pooled": Metric("hierarchy.hierarchical_consistency", False),
    "view_consistency": Metric("masks.iou", True),
    "class_iou": Metric("point_classes.class_iou", False),
    "class_accuracy": Metric("point_classes.class_accuracy", False),
    "miou_present": Metric("point_classes.miou_over_present", False),
    "macc_present": Metric("point_classes.macc_over_present", False),
    "miou_occurring": Metric("point_classes.miou_over_occurring", False),
    "miou_head": Metric("point_classes.miou_over_occurring", False),
    "miou_common": Metric("point_classes.miou_over_occurring", False),
    "miou_tail": Metric("point_classes.miou_over_occurring", False),
    "miou_all": Metric("point_classes.miou_over_all", False, None),
    "macc_all": Metric("point_classes.macc_over_all", False, None),
    "miou_absent_as_one": Metric("point_classes.miou_absent_as_one", False),
    "frequency_weighted_iou": Metric("point_classes.frequency_weighted_iou", False),
    "ap": Metric("instances.ap", False),
    "ap50": Metric("instances.ap50", False),
    "ap25": Metric("instances.ap25", False),
    "ap_head": Metric("instances.ap", False),
    "ap_common": Metric("instances.ap", False),
    "ap_tail": Metric("instances.ap", False),
}
