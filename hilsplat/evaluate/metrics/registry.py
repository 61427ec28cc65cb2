"""Every metric that a row of `scores.csv` may carry."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """What a metric's value means.

    Attributes:
        function: module and name of what computes it, under `hilsplat.evaluate.metrics`.
        symmetric: exchanging prediction and truth leaves it as it is.
        bounds: smallest and largest value.
        averaging: how values of one scene become one number, before scenes are averaged.
        uses_truth_to_choose: a diagnostic that sees the truth before it answers.
    """

    function: str
    symmetric: bool
    bounds: tuple[float, float]
    averaging: str
    uses_truth_to_choose: bool = False


PAIRS = "mean over (view, query) pairs"
VIEWS = "mean over views with at least one parent"

METRICS: dict[str, Metric] = {
    "iou": Metric("masks.iou", True, (0.0, 1.0), PAIRS),
    "boundary_iou": Metric("masks.boundary_iou", True, (0.0, 1.0), PAIRS),
    "best_threshold_iou": Metric("masks.best_threshold_iou", False, (0.0, 1.0), PAIRS, True),
    "localization_box": Metric("localization.hits_a_box", False, (0.0, 1.0), PAIRS),
    "localization_mask": Metric("localization.hits_the_mask", False, (0.0, 1.0), PAIRS),
    "hc_containment": Metric("hierarchy.hierarchical_consistency", False, (0.0, 1.0), VIEWS),
    "hc_literal": Metric("hierarchy.hierarchical_consistency", False, (0.0, 1.0), VIEWS),
    "hc_anchored": Metric("hierarchy.hierarchical_consistency", False, (0.0, 1.0), VIEWS),
}

BUILDING_BLOCKS: frozenset[str] = frozenset(
    {
        "masks.boundary",
        "masks.boundary_width_px",
        "relevancy_rule.filter_side_px",
        "relevancy_rule.level_by_mean_in_mask",
        "relevancy_rule.majority_smooth",
        "relevancy_rule.mean_filter",
        "relevancy_rule.relevancy_mask",
        "relevancy_rule.threshold_mask",
        "localization.box_of",
        "localization.peak_points",
        "hierarchy.family_consistency",
        "averages.accuracy_at",
        "averages.mean_over_classes",
        "averages.mean_over_levels",
        "averages.mean_over_pairs",
    }
)
"""Public functions of this package that are no metric of a row; a test lets none be in neither list."""
