"""Automatic mask generation: a grid of prompts becomes masks at three levels.

Two halves. `candidates.decode_candidates` runs the networks and depends on few settings; what it
returns is cached. `masks_from_candidates` filters, upscales and suppresses; changing its knobs costs
no network call. The steps are SAM's automatic generator, kept apart for the three heads as LangSplat does,
then LangSplat's mask suppression.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Int32

from hilsplat.segment import sam
from hilsplat.segment.candidates import Candidates, crop_boxes
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import HEADS, Frame, SamModel, restore
from hilsplat.segment.suppression import suppress_boxes, suppress_masks
from hilsplat.settings import MasksSettings

CROP_EDGE_PX = 20
"""A mask whose box comes this close to a crop's edge, other than the image's, was cut there (SAM)."""


def masks_from_candidates(
    candidates: Candidates, size_hw: tuple[int, int], model: SamModel, settings: MasksSettings
) -> HierarchicalMasks:
    """Thresholds, upscaling, and the four suppressions: boxes in a crop, boxes across crops, boxes again
    after small islands and holes are gone, masks.

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
            masks = _upscale(candidates, rows, frame, crop_box, size_hw, int(level))
            keep = suppress_boxes(masks.box_xyxy, masks.predicted_iou, settings.box_nms_iou)
            per_crop.append(masks.take(keep))
            layers.append(np.full(len(keep), layer_of[crop]))
        masks, layer = HierarchicalMasks.concatenate(per_crop, size_hw), np.concatenate(layers)
        if settings.crop_layers:  # smaller crops saw more detail (SAM)
            masks = masks.take(
                suppress_boxes(masks.box_xyxy, layer + masks.predicted_iou / 2, settings.box_nms_iou)
            )
        # Mending costs most, so it comes after the boxes have thinned the masks out, as in SAM.
        masks, changed = _mend(masks, settings.min_area_px)
        if changed.any():  # mending moved boxes; masks that needed none are better (SAM)
            keep = suppress_boxes(masks.box_xyxy, ~changed + masks.predicted_iou / 2, settings.box_nms_iou)
            masks = masks.take(keep)
        streams.append(masks)
    return suppress_masks(
        HierarchicalMasks.concatenate(streams, size_hw),
        iou_max=settings.nms_iou,
        score_min=settings.nms_score,
        inner=settings.nms_inner,
    )


def _frame(crop_box: Int32[np.ndarray, " 4"], model: SamModel) -> Frame:
    """How a crop sat in the network's input."""
    left, top, right, bottom = (int(number) for number in crop_box)
    original = (bottom - top, right - left)
    return Frame(original, sam.resized_size(original, model.longest_edge), model.padded_hw)


def _upscale(
    candidates: Candidates,
    rows: np.ndarray,
    frame: Frame,
    crop_box: Int32[np.ndarray, " 4"],
    size_hw: tuple[int, int],
    level: int,
) -> HierarchicalMasks:
    """Masks of the given candidates in the view, without empty ones and those cut by the crop's edge."""
    left, top, right, bottom = (int(number) for number in crop_box)
    parts = []
    for row in rows:
        full = np.zeros((1, *size_hw), dtype=bool)
        full[0, top:bottom, left:right] = restore(candidates.logits[row], frame)
        if not full.any():
            continue
        mask = HierarchicalMasks.from_dense(
            full,
            np.array([level], np.uint8),
            candidates.predicted_iou[row : row + 1],
            candidates.stability[row : row + 1],
        )
        if not _cut_by_crop(mask.box_xyxy[0], crop_box, size_hw):
            parts.append(mask)
    return HierarchicalMasks.concatenate(parts, size_hw)


def _mend(masks: HierarchicalMasks, min_area_px: int) -> tuple[HierarchicalMasks, Bool[np.ndarray, " m"]]:
    """Masks without small holes and islands, those that are small as a whole left out.

    Returns:
        the masks left, and which of them were changed.
    """
    parts, mended = [], []
    for row in range(len(masks)):
        inside, changed = remove_small_regions(masks.dense(np.array([row]))[0], min_area_px)
        if inside.sum() < min_area_px:
            continue
        one = slice(row, row + 1)
        parts.append(
            HierarchicalMasks.from_dense(
                inside[None], masks.level[one], masks.predicted_iou[one], masks.stability[one]
            )
        )
        mended.append(changed)
    return HierarchicalMasks.concatenate(parts, masks.size_hw), np.array(mended, dtype=bool)


def _cut_by_crop(
    box: Int32[np.ndarray, " 4"], crop_box: Int32[np.ndarray, " 4"], size_hw: tuple[int, int]
) -> bool:
    """Whether a box touches an edge of its crop that is no edge of the image."""
    image_box = np.array([0, 0, size_hw[1], size_hw[0]])
    near_crop = np.abs(box - crop_box) <= CROP_EDGE_PX
    near_image = np.abs(box - image_box) <= CROP_EDGE_PX
    return bool((near_crop & ~near_image).any())


def remove_small_regions(
    mask: Bool[np.ndarray, "H W"], min_area_px: int
) -> tuple[Bool[np.ndarray, "H W"], bool]:
    """Fill holes and drop islands below `min_area_px` (8-connected); the largest island always stays.

    Returns:
        the mended mask, and whether anything changed.
    """
    holes, hole_area = _regions(~mask)
    small = np.flatnonzero(hole_area < min_area_px)
    mended = mask | np.isin(holes, small + 1) if len(small) else mask
    islands, island_area = _regions(mended)
    small = np.flatnonzero(island_area < min_area_px)
    if len(island_area):
        small = small[small != island_area.argmax()]
    if len(small):
        mended = mended & ~np.isin(islands, small + 1)
    return mended, bool((mended != mask).any())


def _regions(mask: Bool[np.ndarray, "H W"]) -> tuple[Int32[np.ndarray, "H W"], Int32[np.ndarray, " n"]]:
    """Labels 1..n of the 8-connected regions (0 outside) and their areas, px."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return labels, stats[1:, cv2.CC_STAT_AREA]
