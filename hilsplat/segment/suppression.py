"""Suppression of masks that repeat a better mask; first boxes are compared, then pixels."""

import numpy as np
from jaxtyping import Bool, Float, Int, Int64, Real

from hilsplat.base.levels import LEVELS
from hilsplat.segment.masks import HierarchicalMasks

BOXES_AT_ONCE = 256  # boxes compared with all following ones in one step
INNER_COVERED = 0.85
"""A mask counts as contained if at least this share of it is inside another mask (LangSplat)."""
INNER_COVERS = 0.5  # a contained mask must cover less than this share of its container (LangSplat)


def box_iou(boxes_a: Int[np.ndarray, "A 4"], boxes_b: Int[np.ndarray, "B 4"]) -> Float[np.ndarray, "A B"]:
    """Return the IoU of boxes (xyxy, px, end exclusive); 0 if both are empty."""
    shared = np.ones((len(boxes_a), len(boxes_b)))
    for axis in (0, 1):
        low = np.maximum(boxes_a[:, None, axis], boxes_b[None, :, axis])
        high = np.minimum(boxes_a[:, None, axis + 2], boxes_b[None, :, axis + 2])
        shared *= np.maximum(high - low, 0)
    area_a = np.prod((boxes_a[:, 2:] - boxes_a[:, :2]).astype(np.float64), axis=1)
    area_b = np.prod((boxes_b[:, 2:] - boxes_b[:, :2]).astype(np.float64), axis=1)
    union = area_a[:, None] + area_b[None, :] - shared
    return np.where(union > 0, shared / np.where(union > 0, union, 1), 0.0)


def last_inside(boxes_xyxy: Int[np.ndarray, "M 4"]) -> Int[np.ndarray, "M 4"]:
    """Convert boxes with exclusive maxima to boxes with inclusive maxima, as in SAM."""
    return boxes_xyxy - np.array([0, 0, 1, 1], boxes_xyxy.dtype)


def suppress_boxes(
    boxes_xyxy: Int[np.ndarray, "M 4"],
    score: Float[np.ndarray, " M"],
    iou_max: float,
    first: Float[np.ndarray, " M"] | None = None,
) -> Int64[np.ndarray, " k"]:
    """Return the rows of boxes kept by SAM's greedy suppression, ascending.

    The best box is kept and drops every other box whose IoU with it exceeds `iou_max`; this is repeated for
    the remaining boxes. Boxes are ranked by `first`, if given, then by score, larger area, the box's
    coordinates and row.
    """
    area = np.prod(boxes_xyxy[:, 2:] - boxes_xyxy[:, :2], axis=1, dtype=np.int64)
    ranks = [] if first is None else [-first]
    order = np.lexsort((*boxes_xyxy.T[::-1], -area, -score, *ranks))
    return np.sort(order[distinct_boxes(boxes_xyxy[order], -np.arange(len(order)), iou_max)])


def distinct_boxes(
    boxes_xyxy: Int[np.ndarray, "M 4"],
    score: Real[np.ndarray, " M"],
    iou_max: float,
    stability: Float[np.ndarray, " M"] | None = None,
    slack: float = 0.0,
) -> Int64[np.ndarray, " k"]:
    """Return the rows kept by a suppression that is valid for any thresholds, the best first.

    The box with the highest score (on a tie, the lower row) is kept and drops every other box whose IoU with
    it exceeds `iou_max` and whose stability, if given, is at most `slack` above the kept box's; this is
    repeated for the remaining boxes. Except for the slack, a box that passes a threshold is dropped only by
    a box that also passes it. Without stabilities, for boxes with inclusive maxima (`last_inside`), this is
    SAM's suppression as published.
    """
    order = np.argsort(-score, kind="stable")
    boxes = boxes_xyxy[order]
    if stability is not None:
        stability = stability[order]
    alive = np.ones(len(boxes), dtype=bool)
    for start in range(0, len(boxes), BOXES_AT_ONCE):
        block = np.flatnonzero(alive[start : start + BOXES_AT_ONCE]) + start
        allowed = box_iou(boxes[block], boxes[start:]) <= iou_max
        if stability is not None:
            allowed |= stability[start:] > stability[block, None] + slack
        for row, is_allowed in zip(block, allowed, strict=True):
            if alive[row]:
                alive[row + 1 :] &= is_allowed[row + 1 - start :]
    return order[alive]


def keep_best_masks(
    overlap_px: Int64[np.ndarray, "M M"],
    score: Float[np.ndarray, " M"],
    *,
    iou_max: float,
    score_min: float,
    inner: float,
) -> Bool[np.ndarray, " M"]:
    """Return the masks kept by LangSplat's suppression within one level, for rows in a fixed order.

    With I shared pixels and areas a, row j is dropped if any of these holds:
    - its score is not above `score_min`, unless that is 0;
    - a row with a better score (on a tie, a lower row) has an IoU with it above `iou_max`;
    - it is inside a row i: `I / a_j >= 0.85`, `I / a_i < 0.5` and
      `1 - (I / a_i) (I / a_j) > 1 - inner`. The left side exceeds 0.5, so `inner = 0.5` drops every
      contained mask regardless of its score (masks then nest between levels only), and
      `inner = 0` drops none (masks also nest within levels).
    As in LangSplat, dropped rows still drop others, so the result doesn't depend on the processing order.
    """
    area_px = np.diagonal(overlap_px)
    union_px = area_px[:, None] + area_px[None, :] - overlap_px
    iou = overlap_px / union_px
    rank = np.empty(len(score), dtype=np.int64)
    rank[np.argsort(-score, kind="stable")] = np.arange(len(score))
    better = rank[:, None] < rank[None, :]
    repeated = (better & (iou > iou_max)).any(axis=0)
    share = overlap_px / area_px[:, None]  # [i, j]: share of i inside j
    inside = (share.T >= INNER_COVERED) & (share < INNER_COVERS)  # [i, j]: j is inside i
    contained = (inside & (share * share.T < inner)).any(axis=0)
    return ((score > score_min) | (score_min == 0)) & ~repeated & ~contained


def suppress_masks(
    masks: HierarchicalMasks, *, iou_max: float, score_min: float, inner: float
) -> HierarchicalMasks:
    """Suppress masks within each level (`keep_best_masks`, score = predicted IoU x stability).

    The result is in `content_order`, so shuffled input gives the same result. A level may become empty.
    """
    masks = masks.take(masks.content_order())
    best = []
    for level in LEVELS:
        rows = masks.rows_of(level)
        of_level = masks.take(rows)
        score = of_level.predicted_iou.astype(np.float64) * of_level.stability
        overlap_px = of_level.overlaps_px()
        best.append(
            rows[keep_best_masks(overlap_px, score, iou_max=iou_max, score_min=score_min, inner=inner)]
        )
    return masks.take(np.concatenate(best))
