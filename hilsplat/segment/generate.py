"""Automatic mask generation: a grid of prompts becomes masks at three levels.

Two halves. `decode_candidates` runs the networks and depends on few settings; what it returns is
cached. `masks_from_candidates` filters, upscales and suppresses; changing its knobs costs no network
call. The steps are SAM's automatic generator, kept apart for the three heads as LangSplat does,
then LangSplat's mask suppression.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32, UInt8

from hilsplat.base import onnx_models
from hilsplat.base.artifacts import sha256_of_file, sha256_of_json
from hilsplat.segment import sam
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import HEADS, Frame, SamModel, point_grid, restore, stability_of
from hilsplat.segment.suppression import suppress_boxes, suppress_masks
from hilsplat.settings import MasksSettings

LOOSE = 0.1
"""Masks below this predicted IoU or stability are not even cached (nor below a lower threshold of the settings)."""

CROP_OVERLAP = 512 / 1500
"""Overlap of the first layer's crops, as a share of the image's shorter side (SAM)."""

CROP_EDGE_PX = 20
"""A mask whose box comes this close to a crop's edge, other than the image's, was cut there (SAM)."""


@dataclass(frozen=True)
class Candidates:
    """K masks as the decoder gave them, before any threshold that a user may want to turn.

    Attributes:
        logits: low-resolution logits in steps of `sam.LOGIT_STEP`.
        head: row of `HEADS`.
        predicted_iou: as the network gives it, clipped to [0, 1].
        stability: `sam.stability_of`.
        crop: row of the view's crop boxes.
    """

    logits: Int8[np.ndarray, "K h w"]
    head: UInt8[np.ndarray, " K"]
    predicted_iou: Float32[np.ndarray, " K"]
    stability: Float32[np.ndarray, " K"]
    crop: UInt8[np.ndarray, " K"]

    def arrays(self) -> dict[str, np.ndarray]:
        """All fields as plain arrays."""
        return dict(vars(self))


def crop_boxes(size_hw: tuple[int, int], layers: int) -> tuple[Int32[np.ndarray, "C 4"], UInt8[np.ndarray, " C"]]:
    """Boxes (xyxy, px) of the whole image and of each layer's overlapping crops, and their layers.

    Layer i has 2**i crops per side; crops of one layer overlap by 512/1500 of the shorter side,
    divided by 2**(i - 1).
    """
    height, width = size_hw
    boxes, layer_of = [(0, 0, width, height)], [0]
    for layer in range(1, layers + 1):
        per_side = 2**layer
        overlap = int(CROP_OVERLAP * min(size_hw) * 2 / per_side)
        crop_h = -(-(overlap * (per_side - 1) + height) // per_side)
        crop_w = -(-(overlap * (per_side - 1) + width) // per_side)
        for column in range(per_side):
            for row in range(per_side):
                left, top = column * (crop_w - overlap), row * (crop_h - overlap)
                boxes.append((left, top, min(left + crop_w, width), min(top + crop_h, height)))
                layer_of.append(layer)
    return np.array(boxes, dtype=np.int32), np.array(layer_of, dtype=np.uint8)


def candidates_key(image_sha256: str, model: SamModel, settings: MasksSettings) -> str:
    """Cache key of a view's candidates: everything that `decode_candidates` depends on."""
    code = [sha256_of_file(Path(module.__file__)) for module in (sam, onnx_models)]
    return sha256_of_json(
        {
            "image": image_sha256,
            "model": model.digest,
            "providers": model.encoder.providers,
            "points_per_side": settings.points_per_side,
            "points_per_batch": model.prompts_per_call(settings.points_per_batch),
            "crop_layers": settings.crop_layers,
            "stability_offset": settings.stability_offset,
            "floors": floors(settings),
            "code": [*code, CROP_OVERLAP],
        }
    )


def floors(settings: MasksSettings) -> tuple[float, float]:
    """Predicted IoU and stability below which candidates are not kept."""
    return min(LOOSE, settings.predicted_iou_min), min(LOOSE, settings.stability_min)


def decode_candidates(
    image: UInt8[np.ndarray, "H W 3"], model: SamModel, settings: MasksSettings
) -> Candidates:
    """Prompt the network at every grid point of the image and of its crops."""
    iou_floor, stability_floor = floors(settings)
    boxes, _ = crop_boxes((image.shape[0], image.shape[1]), settings.crop_layers)
    batch = model.prompts_per_call(settings.points_per_batch)
    grid = point_grid(settings.points_per_side)
    parts = []
    for crop, (left, top, right, bottom) in enumerate(boxes):
        encoded = model.encode(np.ascontiguousarray(image[top:bottom, left:right]))
        points = grid * (right - left, bottom - top)
        for start in range(0, len(points), batch):
            asked = points[start : start + batch]
            # Every call has the same number of prompts: some networks fix it, and results then
            # cannot depend on how a batch was cut.
            padded = np.concatenate([asked, np.repeat(asked[-1:], batch - len(asked), axis=0)])
            scores, logits = model.decode(encoded, padded)
            scores = np.clip(scores[: len(asked)].reshape(-1), 0, 1)
            steps = sam.quantise(logits[: len(asked)]).reshape(-1, *logits.shape[2:])
            stability = stability_of(steps, settings.stability_offset, encoded.frame)
            keep = (scores >= iou_floor) & (stability >= stability_floor) & (steps > 0).any(axis=(1, 2))
            head = np.tile(np.arange(len(HEADS), dtype=np.uint8), len(asked))
            parts.append(
                (steps[keep], head[keep], scores[keep], stability[keep], np.full(keep.sum(), crop, np.uint8))
            )
    return Candidates(*(np.concatenate(column) for column in zip(*parts, strict=True)))


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
        per_crop = []
        for crop, crop_box in enumerate(boxes):
            rows = np.flatnonzero(enough & (candidates.head == head) & (candidates.crop == crop))
            frame = _frame(crop_box, model)
            masks, changed = _upscale(candidates, rows, frame, crop_box, size_hw, int(level), settings)
            keep = suppress_boxes(masks.box_xyxy, masks.predicted_iou, settings.box_nms_iou)
            per_crop.append((masks.take(keep), changed[keep], np.full(len(keep), layer_of[crop])))
        masks = HierarchicalMasks.concatenate([part[0] for part in per_crop], size_hw)
        changed = np.concatenate([part[1] for part in per_crop])
        layer = np.concatenate([part[2] for part in per_crop])
        # Smaller crops saw more detail, untouched masks are better than mended ones (SAM).
        for score in (layer.astype(np.float64), (~changed).astype(np.float64)):
            if score.any() and not score.all():
                preference = score + masks.predicted_iou / 2
                keep = suppress_boxes(masks.box_xyxy, preference, settings.box_nms_iou)
                masks, changed = masks.take(keep), changed[keep]
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
    settings: MasksSettings,
) -> tuple[HierarchicalMasks, Bool[np.ndarray, " m"]]:
    """Masks of the given candidates in the view, mended, without those cut by the crop's edge.

    Returns:
        the masks left, and which of them were mended.
    """
    left, top, right, bottom = (int(number) for number in crop_box)
    parts, mended = [], []
    for row in rows:
        inside, changed = remove_small_regions(restore(candidates.logits[row], frame), settings.min_area_px)
        if inside.sum() < settings.min_area_px:
            continue
        full = np.zeros((1, *size_hw), dtype=bool)
        full[0, top:bottom, left:right] = inside
        mask = HierarchicalMasks.from_dense(
            full,
            np.array([level], np.uint8),
            candidates.predicted_iou[row : row + 1],
            candidates.stability[row : row + 1],
        )
        if not _cut_by_crop(mask.box_xyxy[0], crop_box, size_hw):
            parts.append(mask)
            mended.append(changed)
    return HierarchicalMasks.concatenate(parts, size_hw), np.array(mended, dtype=bool)


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
