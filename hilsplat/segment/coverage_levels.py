"""Levels from the coverage tree of a view, for segmenters whose own levels mean little."""

from dataclasses import replace

import numpy as np

from hilsplat.base.levels import Level
from hilsplat.segment.coverage import depths, parents_from_overlaps
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.suppression import suppress_masks
from hilsplat.settings import MasksSettings


def with_coverage_levels(masks: HierarchicalMasks, settings: MasksSettings) -> HierarchicalMasks:
    """Level of each mask by its depth among all masks of the view: roots are wholes, and so on.

    Masks of all levels are pooled first, and of those that say the same (IoU above `nms_iou`) the best
    stays. A mask deeper than three is a subpart. What the paper's source mentions and leaves out.

    Args:
        masks: of all levels, before or after suppression inside levels.
        settings: `level_theta` and thresholds of the suppression.

    Returns:
        masks suppressed inside their new levels, in `content_order`.
    """
    thresholds = {"iou_max": settings.nms_iou, "score_min": settings.nms_score}
    # nesting is what the depths come from: the inner rule waits until they are known
    pooled = replace(masks, level=np.full(len(masks), int(Level.WHOLE), np.uint8))
    pooled = suppress_masks(pooled, inner=0.0, **thresholds)
    depth = depths(parents_from_overlaps(pooled.overlaps_px(), settings.level_theta))
    level = np.minimum(depth, int(Level.SUBPART)).astype(np.uint8)
    return suppress_masks(replace(pooled, level=level), inner=settings.nms_inner, **thresholds)
