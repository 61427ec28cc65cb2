"""Automatic mask generation: from a grid of prompts to masks at three levels.

`candidates.decode_candidates` runs the networks and depends on few settings; its result is cached.
`masks_from_candidates` filters, upscales and suppresses; changing its settings costs no network call. The
steps are SAM's automatic generator, run separately for the three heads as in LangSplat, then LangSplat's mask
suppression. With `generator: official`, each step is as published (docs/segment.md lists the differences).
"""

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from hilsplat.base.levels import Level
from hilsplat.segment.candidates import Candidates, crop_boxes
from hilsplat.segment.kernels import cleaned_runs, upscaled_runs
from hilsplat.segment.masks import HierarchicalMasks, take_runs
from hilsplat.segment.sam import HEADS, Frame, SamModel, frame_taps
from hilsplat.segment.suppression import (
    last_inside,
    suppress_boxes,
    suppress_boxes_officially,
    suppress_masks,
)
from hilsplat.settings import MasksSettings

CROP_EDGE_PX = 20
"""A crop cut a mask if its box is this close to an edge of the crop that isn't the image's (SAM)."""


def masks_from_candidates(
    candidates: Candidates, size_hw: tuple[int, int], model: SamModel, settings: MasksSettings
) -> HierarchicalMasks:
    """Threshold and upscale candidates, remove small holes and islands, and suppress repeats.

    Suppression compares boxes in a crop, boxes across crops, boxes of changed masks, and masks.

    Returns:
        masks in `content_order`; a level may be empty.
    """
    thresholds = model.thresholds(settings)
    official = settings.generator == "official"
    boxes, layer_of = crop_boxes(size_hw, settings.crop_layers)
    # smaller crops show more detail (SAM): `official` prefers a smaller area, ours a deeper layer
    preferred = 1 / np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) if official else layer_of
    enough = (candidates.predicted_iou > thresholds.predicted_iou_min) | (thresholds.predicted_iou_min == 0)
    enough &= candidates.stability >= thresholds.stability_min
    streams = []
    for head, level in enumerate(HEADS):
        per_crop, ranks = [], []
        for crop, crop_box in enumerate(boxes):
            rows = np.flatnonzero(enough & (candidates.head == head) & (candidates.crop == crop))
            left, top, right, bottom = crop_box.tolist()
            frame = model.frame((bottom - top, right - left))
            masks = _upscale(candidates, rows, frame, crop_box, size_hw, level, official)
            masks = _suppressed(masks, None, settings)
            per_crop.append(masks)
            ranks.append(np.full(len(masks), preferred[crop], np.float64))
        masks = HierarchicalMasks.concatenate(per_crop, size_hw)
        if settings.crop_layers:
            masks = _suppressed(masks, np.concatenate(ranks), settings)
        # this is the most expensive step, so it follows the suppression by boxes, as in SAM
        masks, changed = clean_masks(masks, settings.min_area_px, keep_small=official)
        if changed.any():  # boxes have changed; unchanged masks are preferred (SAM)
            masks = _suppressed(masks, (~changed).astype(np.float64), settings)
        streams.append(masks)
    pooled = HierarchicalMasks.concatenate(streams, size_hw)
    limits = {"iou_max": settings.nms_iou, "score_min": thresholds.nms_score, "inner": settings.nms_inner}
    return suppress_masks(pooled, **limits)


def _suppressed(
    masks: HierarchicalMasks, first: Float64[np.ndarray, " M"] | None, settings: MasksSettings
) -> HierarchicalMasks:
    """Drop masks whose box repeats that of a better mask, by `first`, then by predicted IoU."""
    suppress = suppress_boxes_officially if settings.generator == "official" else suppress_boxes
    return masks.take(suppress(masks.box_xyxy, masks.predicted_iou, settings.box_nms_iou, first))


def _upscale(
    candidates: Candidates,
    rows: Int64[np.ndarray, " m"],
    frame: Frame,
    crop_box: Int32[np.ndarray, " 4"],
    size_hw: tuple[int, int],
    level: Level,
    official: bool,
) -> HierarchicalMasks:
    """Upscale candidates to masks of the view, without empty ones and those cut by the crop's edge."""
    low_h, low_w = candidates.low_hw.tolist()
    runs, offsets = upscaled_runs(
        candidates.logits,
        candidates.offsets,
        candidates.window_xyxy,
        rows,
        *frame_taps((low_h, low_w), frame),
        int(crop_box[1]),
        int(crop_box[0]),
        *size_hw,
    )
    # a mask with a single run is empty
    keep = np.flatnonzero(np.diff(offsets) > 1)
    runs, offsets = take_runs(runs, offsets, keep)
    masks = HierarchicalMasks.from_runs(
        runs, offsets, level, candidates.predicted_iou[rows[keep]], candidates.stability[rows[keep]], size_hw
    )
    met = last_inside(masks.box_xyxy) if official else masks.box_xyxy
    return masks.take(np.flatnonzero(~cut_by_crop(met, crop_box, size_hw)))


def clean_masks(
    masks: HierarchicalMasks, min_area_px: int, keep_small: bool = False
) -> tuple[HierarchicalMasks, Bool[np.ndarray, " m"]]:
    """Fill holes and drop islands below `min_area_px` (8-connected), and drop masks below it.

    The largest island of a mask is always kept. With `keep_small`, masks below `min_area_px` are kept and
    count as changed (SAM).

    Returns:
        the remaining masks, and which of them were changed.
    """
    runs, offsets, changed = cleaned_runs(masks.runs, masks.offsets, masks.size_hw[1], min_area_px)
    cleaned = HierarchicalMasks.from_runs(
        runs, offsets, masks.level, masks.predicted_iou, masks.stability, masks.size_hw
    )
    is_small = cleaned.area_px < min_area_px
    if keep_small:
        return cleaned, changed | is_small
    large = np.flatnonzero(~is_small)
    return cleaned.take(large), changed[large]


def cut_by_crop(
    boxes: Int32[np.ndarray, "M 4"], crop_box: Int32[np.ndarray, " 4"], size_hw: tuple[int, int]
) -> Bool[np.ndarray, " M"]:
    """Return which boxes touch an edge of their crop that is not an edge of the image."""
    image_box = np.array([0, 0, size_hw[1], size_hw[0]])
    near_crop = np.abs(boxes - crop_box) <= CROP_EDGE_PX
    near_image = np.abs(boxes - image_box) <= CROP_EDGE_PX
    return (near_crop & ~near_image).any(axis=1)
