"""SAM's automatic generator for three heads and LangSplat's suppression, as published: dense, one by one."""

import cv2
import numpy as np
import torch
from torch.nn.functional import interpolate

from hilsplat.segment.generate import crop_boxes
from hilsplat.segment.sam import SamModel, point_grid
from hilsplat.settings import MasksSettings


def full_size(logits: np.ndarray, frame) -> np.ndarray:
    """`Sam.postprocess_masks`: logits (K, h, w) at the size of the picture."""
    large = interpolate(torch.from_numpy(logits)[None], frame.padded_hw, mode="bilinear", align_corners=False)
    cut = large[..., : frame.resized_hw[0], : frame.resized_hw[1]]
    return interpolate(cut, frame.original_hw, mode="bilinear", align_corners=False)[0].numpy()


def box_of(mask: np.ndarray) -> list[int]:
    """`batched_mask_to_box`: the last row and column are inside."""
    ys, xs = np.nonzero(mask)
    return [xs.min(), ys.min(), xs.max(), ys.max()] if len(ys) else [0, 0, 0, 0]


def nms(boxes: np.ndarray, scores: np.ndarray, iou_max: float) -> list[int]:
    """torchvision's: rows kept, the best first; equal scores in their order."""
    kept: list[int] = []
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    for row in np.argsort(-scores, kind="stable"):
        for better in kept:
            low = np.maximum(boxes[row, :2], boxes[better, :2])
            high = np.minimum(boxes[row, 2:], boxes[better, 2:])
            shared = np.prod(np.maximum(high - low, 0))
            if shared / max(areas[row] + areas[better] - shared, 1e-9) > iou_max:
                break
        else:
            kept.append(int(row))
    return kept


def without_small_regions(mask: np.ndarray, area: int, mode: str) -> tuple[np.ndarray, bool]:
    """`remove_small_regions`."""
    holes = mode == "holes"
    count, regions, stats, _ = cv2.connectedComponentsWithStats(
        (holes ^ mask).astype(np.uint8), connectivity=8
    )
    sizes = stats[1:, -1]
    small = [at + 1 for at, size in enumerate(sizes) if size < area]
    if not small:
        return mask, False
    fill = [0, *small]
    if not holes:
        fill = [at for at in range(count) if at not in fill] or [int(sizes.argmax()) + 1]
    return np.isin(regions, fill), True


def suppress(masks: np.ndarray, scores: np.ndarray, settings: MasksSettings, score_min: float) -> list[int]:
    """LangSplat's `mask_nms`."""
    order = np.argsort(-scores, kind="stable")
    dropped = scores <= score_min
    areas = masks.sum(axis=(1, 2))
    for place, i in enumerate(order):
        for j in order[place + 1 :]:
            shared = (masks[i] & masks[j]).sum()
            if shared / (masks[i] | masks[j]).sum() > settings.nms_iou:
                dropped[j] = True
            in_i, in_j = shared / areas[i], shared / areas[j]
            if 1 - in_i * in_j > 1 - settings.nms_inner:
                if in_i < 0.5 and in_j >= 0.85:
                    dropped[j] = True
                if in_i >= 0.85 and in_j < 0.5:
                    dropped[i] = True
    return [row for row in range(len(scores)) if not dropped[row]]


def generate(
    image: np.ndarray, model: SamModel, settings: MasksSettings
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Masks (M, H, W) and predicted IoUs of each head."""
    thresholds = model.thresholds(settings)
    height, width = image.shape[:2]
    boxes, _ = crop_boxes((height, width), settings.crop_layers)
    heads: list[list] = [[], [], []]
    for left, top, right, bottom in boxes:
        encoded = model.encode(np.ascontiguousarray(image[top:bottom, left:right]))
        points = point_grid(settings.points_per_side) * (right - left, bottom - top)
        scores, logits = model.decode(encoded, points)
        for head in range(3):
            found = []
            for score, large in zip(scores[:, head], full_size(logits[:, head], encoded.frame), strict=True):
                above = (large > settings.stability_offset).sum(), (large > -settings.stability_offset).sum()
                stability = np.float32(above[0] / above[1]) if above[1] else np.nan
                if not (score > thresholds.predicted_iou_min and stability >= thresholds.stability_min):
                    continue
                box = np.add(box_of(large > 0), [left, top, left, top])
                near = np.abs(box - [left, top, right, bottom]) <= 20
                if (near & ~(np.abs(box - [0, 0, width, height]) <= 20)).any():
                    continue
                mask = np.zeros((height, width), bool)
                mask[top:bottom, left:right] = large > 0
                found.append((mask, score, stability, box, (right - left) * (bottom - top)))
            found_boxes = np.array([one[3] for one in found]).reshape(-1, 4)
            rows = nms(found_boxes, np.array([one[1] for one in found]), settings.box_nms_iou)
            heads[head] += [found[row] for row in rows]
    results = []
    for found in heads:
        if len(boxes) > 1:
            preferred = np.array([1 / one[4] for one in found])
            rows = nms(np.array([one[3] for one in found]), preferred, settings.box_nms_iou)
            found = [found[row] for row in rows]
        cleaned, unchanged = [], []
        for mask, *_ in found:
            mask, holes = without_small_regions(mask, settings.min_area_px, "holes")
            mask, islands = without_small_regions(mask, settings.min_area_px, "islands")
            cleaned.append(mask)
            unchanged.append(float(not (holes or islands)))
        rows = nms(np.array([box_of(mask) for mask in cleaned]), np.array(unchanged), settings.box_nms_iou)
        masks = np.stack([cleaned[row] for row in rows])
        quality = np.array([found[row][1] * np.float64(found[row][2]) for row in rows])
        kept = suppress(masks, quality, settings, thresholds.nms_score)
        results.append((masks[kept], np.array([found[rows[row]][1] for row in kept])))
    return results
