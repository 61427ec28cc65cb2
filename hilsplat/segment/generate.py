"""Automatic mask generation: a grid of prompts becomes masks at three levels.

Two halves. `candidates.decode_candidates` runs the networks and depends on few settings; what it
returns is cached. `masks_from_candidates` filters, upscales and suppresses; changing its knobs costs
no network call. The steps are SAM's automatic generator, run separately for the three heads as in
LangSplat, then LangSplat's mask suppression.
"""

import numpy as np
from jaxtyping import Bool, Int32, Int64

from hilsplat.base.levels import Level
from hilsplat.segment import sam
from hilsplat.segment.candidates import Candidates, crop_boxes
from hilsplat.segment.kernels import mended_runs, upscaled_runs
from hilsplat.segment.masks import HierarchicalMasks, take_runs
from hilsplat.segment.sam import HEADS, Frame, SamModel
from hilsplat.segment.suppression import suppress_boxes, suppress_masks
from hilsplat.settings import MasksSettings

CROP_EDGE_PX = 20
"""A mask whose box comes this close to a crop's edge, other than the image's, was cut there (SAM)."""


def masks_from_candidates(
    candidates: Candidates, size_hw: tuple[int, int], model: SamModel, settings: MasksSettings
) -> HierarchicalMasks:
    """Thresholds, upscaling and four suppressions: boxes in a crop, boxes across crops, boxes again after
    small islands and holes are gone, masks.

    Returns:
        masks in `content_order`; a level may be empty.
    """
    boxes, layer_of = crop_boxes(size_hw, settings.crop_layers)
    enough = (candidates.predicted_iou >= settings.predicted_iou_min) & (
        candidates.stability >= settings.stability_min
    )
    streams = []
    for head, level in enumerate(HEADS):
        per_crop, layers = [], []
        for crop, crop_box in enumerate(boxes):
            rows = np.flatnonzero(enough & (candidates.head == head) & (candidates.crop == crop))
            frame = _frame(crop_box, model)
            masks = _upscale(candidates, rows, frame, crop_box, size_hw, level)
            keep = suppress_boxes(masks.box_xyxy, masks.predicted_iou, settings.box_nms_iou)
            per_crop.append(masks.take(keep))
            layers.append(np.full(len(keep), layer_of[crop]))
        masks, layer = HierarchicalMasks.concatenate(per_crop, size_hw), np.concatenate(layers)
        if settings.crop_layers:  # smaller crops saw more detail (SAM)
            masks = masks.take(
                suppress_boxes(masks.box_xyxy, layer + masks.predicted_iou / 2, settings.box_nms_iou)
            )
        # Mending costs most, so it comes after suppression by boxes, as in SAM.
        masks, changed = mend_masks(masks, settings.min_area_px)
        if changed.any():  # mending moved boxes; masks that needed none are better (SAM)
            keep = suppress_boxes(masks.box_xyxy, ~changed + masks.predicted_iou / 2, settings.box_nms_iou)
            masks = masks.take(keep)
        streams.append(masks)
    pooled = HierarchicalMasks.concatenate(streams, size_hw)
    return suppress_masks(
        pooled,
        iou_max=settings.nms_iou,
        score_min=settings.nms_score,
        inner=settings.nms_inner,
    )


def _frame(crop_box: Int32[np.ndarray, " 4"], model: SamModel) -> Frame:
    """Where a crop was in the network's input."""
    left, top, right, bottom = (int(number) for number in crop_box)
    original = (bottom - top, right - left)
    return Frame(original, sam.resized_size(original, model.longest_edge), model.padded_hw)


def _upscale(
    candidates: Candidates,
    rows: Int64[np.ndarray, " m"],
    frame: Frame,
    crop_box: Int32[np.ndarray, " 4"],
    size_hw: tuple[int, int],
    level: Level,
) -> HierarchicalMasks:
    """Masks of the given candidates in the view, without empty ones and those cut by the crop's edge."""
    along_y, along_x = (
        sam.taps(int(candidates.low_hw[axis]), frame.padded_hw[axis], frame.resized_hw[axis], length)
        for axis, length in enumerate(frame.original_hw)
    )
    runs, offsets = upscaled_runs(
        candidates.logits,
        candidates.offsets,
        candidates.window_xyxy,
        rows,
        *along_y,
        *along_x,
        int(crop_box[1]),
        int(crop_box[0]),
        *size_hw,
    )
    # a single run is a mask without pixels
    keep = np.flatnonzero(np.diff(offsets) > 1)
    runs, offsets = take_runs(runs, offsets, keep)
    masks = HierarchicalMasks.from_runs(
        runs,
        offsets,
        np.full(len(keep), int(level), np.uint8),
        candidates.predicted_iou[rows[keep]],
        candidates.stability[rows[keep]],
        size_hw,
    )
    return masks.take(np.flatnonzero(~cut_by_crop(masks.box_xyxy, crop_box, size_hw)))


def mend_masks(
    masks: HierarchicalMasks, min_area_px: int
) -> tuple[HierarchicalMasks, Bool[np.ndarray, " m"]]:
    """Fill holes and drop islands below `min_area_px` (8-connected), and masks that are small as a whole.

    The largest island of a mask always stays.

    Returns:
        the masks left, and which of them were changed.
    """
    runs, offsets, changed = mended_runs(masks.runs, masks.offsets, masks.size_hw[1], min_area_px)
    mended = HierarchicalMasks.from_runs(
        runs, offsets, masks.level, masks.predicted_iou, masks.stability, masks.size_hw
    )
    large = np.flatnonzero(mended.area_px >= min_area_px)
    return mended.take(large), changed[large]


def cut_by_crop(
    boxes: Int32[np.ndarray, "M 4"], crop_box: Int32[np.ndarray, " 4"], size_hw: tuple[int, int]
) -> Bool[np.ndarray, " M"]:
    """Which boxes touch an edge of their crop that is not an edge of the image."""
    image_box = np.array([0, 0, size_hw[1], size_hw[0]])
    near_crop = np.abs(boxes - crop_box) <= CROP_EDGE_PX
    near_image = np.abs(boxes - image_box) <= CROP_EDGE_PX
    return (near_crop & ~near_image).any(axis=1)
