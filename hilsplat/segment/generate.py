"""Automatic mask generation: from a grid of prompts to masks at three levels.

`decode_candidates` runs the networks and depends on few settings; its result is cached.
`masks_from_candidates` filters, upscales and suppresses them; changing its settings requires no network call.
The steps are those of SAM's automatic generator, run separately for the three heads as in LangSplat, and then
LangSplat's suppression. `generator: official` runs each step as published (differences: docs/segment.md).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int8, Int32, Int64, Real, UInt8

from hilsplat.base.code import code_digest
from hilsplat.base.levels import Level
from hilsplat.base.lineage import sha256_of_bytes, sha256_of_json
from hilsplat.models.card import in_turn
from hilsplat.models.network import Array, on_host
from hilsplat.segment import sam
from hilsplat.segment.kernels import cleaned_runs, upscaled_runs
from hilsplat.segment.masks import HierarchicalMasks, join_rows, take_runs
from hilsplat.segment.suppression import distinct_boxes, last_inside, suppress_boxes, suppress_masks
from hilsplat.segment.thresholds import Thresholds
from hilsplat.settings import MasksSettings

LOOSE = 0.1
"""Masks below this predicted IoU or stability (or the settings' threshold, if lower) are not cached."""
BAND_PX = 3  # logits within this many low-resolution pixels of a mask's edge are kept (see `Candidates`)
REPEAT_IOU = 0.95
"""A preview mask repeats a better one if the IoU of their boxes exceeds this (`distinct_prompts`)."""
REPEAT_SLACK = 0.05
"""Amount by which a repeated mask's preview stability (from few pixels) may exceed the better mask's."""
CROP_OVERLAP = 512 / 1500  # overlap of the first layer's crops, as a share of the image's shorter side (SAM)
CROP_EDGE_PX = 20
"""A mask is truncated if its box is at most this far from a crop edge that isn't an image edge (SAM)."""


@dataclass(frozen=True)
class Candidates:
    """K decoded masks, before any user-defined threshold is applied.

    A mask's logits are stored in a window around it, in steps of `sam.LOGIT_STEP` (unrounded for the official
    generator). Logits with no edge within `BAND_PX` are set to +-127, so that windows compress well. This
    changes no pixel of a mask: the two bilinear resizings to the view's size read logits at most three pixels
    apart. Outside the window, logits are -127.
    """

    logits: Int8[np.ndarray, " R"] | Float32[np.ndarray, " R"]  # concatenated windows, each row by row
    offsets: Int64[np.ndarray, " K_and_1"]  # start of each mask's window, and the end of the last one
    window_xyxy: Int32[np.ndarray, "K 4"]  # low-resolution px, end exclusive
    low_hw: Int32[np.ndarray, " 2"]  # size of the decoder's masks
    head: UInt8[np.ndarray, " K"]  # row of `HEADS`
    predicted_iou: Float32[np.ndarray, " K"]  # exceeds 1 for the most certain masks of released SAMs
    stability: Float32[np.ndarray, " K"]  # `sam.read_logits` or `sam.full_stability`
    crop: UInt8[np.ndarray, " K"]  # row of the view's crop boxes

    @staticmethod
    def concatenate(parts: "list[Candidates]") -> "Candidates":
        """Concatenate the rows of all parts (at least one)."""
        names = ("window_xyxy", "head", "predicted_iou", "stability", "crop")
        return Candidates(low_hw=parts[0].low_hw, **join_rows(parts, "logits", names))


def crop_boxes(
    size_hw: tuple[int, int], layers: int
) -> tuple[Int32[np.ndarray, "C 4"], UInt8[np.ndarray, " C"]]:
    """Return the boxes (xyxy, px) of the image and of each layer's overlapping crops, and each box's layer.

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
                if left < width and top < height:  # images of a few pixels have fewer crops
                    boxes.append((left, top, min(left + crop_w, width), min(top + crop_h, height)))
                    layer_of.append(layer)
    return np.array(boxes, dtype=np.int32), np.array(layer_of, dtype=np.uint8)


def candidates_key(
    image_sha256: str, model: sam.SamModel, settings: MasksSettings, points: np.ndarray | None = None
) -> str:
    """Return the cache key of a view's candidates, a digest of all inputs of `decode_candidates`."""
    thresholds = model.thresholds(settings)
    batch = model.prompts_per_call(thresholds.points_per_batch, settings.points_per_side**2)
    return sha256_of_json(
        {
            "image": image_sha256,
            "model": model.digest,
            "precision": model.precision,
            "providers": model.encoder.runs_on,
            "points_per_side": settings.points_per_side,
            "points": None if points is None else sha256_of_bytes(points.tobytes()),
            "points_per_batch": batch,
            "crop_layers": settings.crop_layers,
            "stability_offset": settings.stability_offset,
            "full_size": needs_full_size(settings),
            "official": settings.generator == "official",
            "preview": uses_preview(model, settings),
            "factored": model.factored is not None,
            "floors": floors(thresholds),
            "code": code_digest(decode_candidates),
        }
    )


def floors(thresholds: Thresholds) -> tuple[float, float]:
    """Return the predicted IoU and stability below which candidates are dropped; 0 drops none."""
    lowest = (min(LOOSE, thresholds.predicted_iou_min), min(LOOSE, thresholds.stability_min))
    return lowest[0] or -math.inf, lowest[1]


def needs_full_size(settings: MasksSettings) -> bool:
    """Return whether stability is computed at the view's size."""
    return settings.stability == "full" or settings.generator == "official"


def decode_candidates(
    image: UInt8[np.ndarray, "H W 3"],
    model: sam.SamModel,
    settings: MasksSettings,
    points: Float[np.ndarray, "P 2"] | None = None,
) -> Candidates:
    """Decode masks at grid points of the image and its crops, skipping repeats (`distinct_prompts`).

    `points` (x, y, px; at least one) replace the grid of the whole image; crops keep their grids.
    """
    boxes, _ = crop_boxes((image.shape[0], image.shape[1]), settings.crop_layers)
    grid = sam.point_grid(settings.points_per_side)
    thresholds = model.thresholds(settings)
    batch = model.prompts_per_call(thresholds.points_per_batch, len(grid))

    def of_crop(crop: int) -> Iterator[Candidates]:
        left, top, right, bottom = boxes[crop]
        encoded = model.encode(np.ascontiguousarray(image[top:bottom, left:right]))
        on_grid = grid * (right - left, bottom - top)
        prompts: sam.Prompts = {"points": on_grid if points is None or crop else points}
        if uses_preview(model, settings):
            prompts = distinct_prompts(encoded, prompts, model, settings, batch)

        def decoded(rows: Int64[np.ndarray, " b"], number: int) -> Candidates:
            called = {name: rows_of[rows] for name, rows_of in prompts.items()}
            scores, logits = (values[:number] for values in model.finish(encoded, called))
            return keep_candidates(scores, logits, encoded.frame, crop, settings, thresholds)

        return model.batches("masks", batch)(len(next(iter(prompts.values()))), decoded)

    return Candidates.concatenate([part for crop in range(len(boxes)) for part in of_crop(crop)])


def uses_preview(model: sam.SamModel, settings: MasksSettings) -> bool:
    """Return whether to skip repeated prompts (requires previews, and suppression of repeats)."""
    may_repeat = settings.generator == "official" or settings.box_nms_iou >= REPEAT_IOU
    return model.previews and not may_repeat


def distinct_prompts(
    encoded: sam.Encoded, prompts: sam.Prompts, model: sam.SamModel, settings: MasksSettings, batch: int
) -> sam.Prompts:
    """Preview prompts and drop each one whose masks all repeat better masks of the same head.

    Masks are compared by their boxes in the preview, which has every second or fourth row and column of the
    decoder's masks (`suppression.distinct_boxes`), before any user-defined threshold is applied. Of 1000
    prompts, 200 to 300 remain; at least one is kept.
    """
    iou_floor, stability_floor = floors(model.thresholds(settings))
    measured, previewed = [], []

    def preview(rows: Int64[np.ndarray, " b"], number: int) -> tuple[tuple[np.ndarray, ...], sam.Prompts]:
        scores, logits, arrays = model.preview(encoded, prompts["points"][rows])
        flat = logits[:number].reshape(-1, *logits.shape[2:])
        _, stability, boxes = sam.read_logits(flat, settings.stability_offset, encoded.frame)
        found = scores[:number], stability.reshape(number, -1), boxes.reshape(number, -1, 4)
        return found, {name: rows_of[:number] for name, rows_of in arrays.items()}

    for measures, arrays in model.batches("previews", batch)(len(prompts["points"]), preview):
        measured.append(measures)
        previewed.append(dict(arrays))
    predicted_iou, stability, boxes = map(np.concatenate, zip(*measured, strict=True))
    likely = (predicted_iou >= iou_floor) & (stability >= stability_floor) & boxes.any(axis=2)
    chosen = np.zeros(len(likely), bool)
    for head in range(len(sam.HEADS)):
        rows = np.flatnonzero(likely[:, head])
        at = rows, head
        distinct = distinct_boxes(boxes[at], predicted_iou[at], REPEAT_IOU, stability[at], REPEAT_SLACK)
        chosen[rows[distinct]] = True
    chosen[0] |= not chosen.any()
    names = list(previewed[0])

    def join() -> sam.Prompts:
        return {name: joined([arrays.pop(name) for arrays in previewed])[chosen] for name in names}

    return in_turn(model.device, "masks", join)


def keep_candidates(
    scores: Float32[np.ndarray, "P 3"],
    logits: Float32[Array, "P 3 h w"],
    frame: sam.Frame,
    crop: int,
    settings: MasksSettings,
    thresholds: Thresholds,
) -> Candidates:
    """Return the masks of one decoder call that pass `floors`."""
    iou_floor, stability_floor = floors(thresholds)
    predicted_iou = scores.reshape(-1)
    flat = logits.reshape(-1, *logits.shape[2:])
    steps, stability, boxes = sam.read_logits(flat, settings.stability_offset, frame)
    if settings.generator == "official":
        steps, boxes = flat, sam.positive_boxes(flat)
    likely = (predicted_iou >= iou_floor) & boxes.any(axis=1)
    if needs_full_size(settings):
        stability[likely] = sam.full_stability(on_host(flat[likely]), settings.stability_offset, frame)
    rows = np.flatnonzero(likely & (stability >= stability_floor))
    values, offsets, windows = edge_windows(steps, rows, boxes)
    return Candidates(
        values,
        offsets,
        windows,
        np.array(steps.shape[1:], np.int32),
        np.tile(np.arange(len(sam.HEADS), dtype=np.uint8), len(scores))[rows],
        predicted_iou[rows],
        stability[rows],
        np.full(len(rows), crop, np.uint8),
    )


def joined(parts: list[Array]) -> Array:
    """Concatenate arrays along the first axis."""
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    import torch

    return torch.cat(parts)


def edge_windows(
    logits: Real[Array, "K h w"], rows: Int64[np.ndarray, " m"], boxes: Int32[np.ndarray, "K 4"]
) -> tuple[Real[np.ndarray, " R"], Int64[np.ndarray, " m_and_1"], Int32[np.ndarray, "m 4"]]:
    """Return the windows of `Candidates` for the given rows: concatenated logits, offsets and boxes (xyxy).

    `boxes` contains the box of the positive logits of every mask; masks in `rows` have some.
    """
    height, width = logits.shape[1:]
    reach = np.array([-BAND_PX, -BAND_PX, BAND_PX, BAND_PX], np.int32)
    windows = np.clip(boxes[rows] + reach, 0, np.array([width, height, width, height], np.int32))
    if not isinstance(logits, np.ndarray):
        from hilsplat.segment import torch_decoder

        values = torch_decoder.windows(logits, rows, windows, BAND_PX)
        sizes = (windows[:, 2:] - windows[:, :2]).prod(axis=1, dtype=np.int64)
        return values, np.concatenate([[0], np.cumsum(sizes)]), windows
    square = np.ones((2 * BAND_PX + 1, 2 * BAND_PX + 1), np.uint8)
    parts = [np.zeros(0, logits.dtype)]
    for row, (x0, y0, x1, y1) in zip(rows.tolist(), windows.tolist(), strict=True):
        window = logits[row, y0:y1, x0:x1].copy()
        inside = (window > 0).view(np.uint8)
        window[cv2.dilate(inside, square) == 0] = -127
        window[cv2.erode(inside, square) > 0] = 127
        parts.append(window.reshape(-1))
    offsets = np.cumsum([len(part) for part in parts], dtype=np.int64)
    return np.concatenate(parts), offsets, windows


def masks_from_candidates(
    candidates: Candidates, size_hw: tuple[int, int], model: sam.SamModel, settings: MasksSettings
) -> HierarchicalMasks:
    """Threshold and upscale candidates, remove small holes and islands, and suppress repeats.

    Suppression compares, in order: boxes within a crop, boxes across crops, boxes of changed masks, pixels.

    The result is in `content_order`; a level may be empty.
    """
    thresholds = model.thresholds(settings)
    official = settings.generator == "official"
    boxes, layer_of = crop_boxes(size_hw, settings.crop_layers)
    # smaller crops show more detail (SAM): `official` prefers smaller crops, ours crops of deeper layers
    preferred = 1 / np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) if official else layer_of
    enough = (candidates.predicted_iou > thresholds.predicted_iou_min) | (thresholds.predicted_iou_min == 0)
    enough &= candidates.stability >= thresholds.stability_min
    streams = []
    for head, level in enumerate(sam.HEADS):
        per_crop, ranks = [], []
        for crop, crop_box in enumerate(boxes):
            rows = np.flatnonzero(enough & (candidates.head == head) & (candidates.crop == crop))
            left, top, right, bottom = crop_box.tolist()
            frame = model.frame((bottom - top, right - left))
            masks = _upscale(candidates, rows, frame, crop_box, size_hw, level, official)
            masks = _suppressed(masks, None, settings)
            per_crop.append(masks)
            ranks.append(np.full(len(masks), preferred[crop], np.float64))
        masks = HierarchicalMasks.concatenate(per_crop)
        if settings.crop_layers:
            masks = _suppressed(masks, np.concatenate(ranks), settings)
        # this is the most expensive step, so it follows the suppression by boxes, as in SAM
        masks, changed = clean_masks(masks, settings.min_area_px, keep_small=official)
        if changed.any():  # boxes have changed; unchanged masks are preferred (SAM)
            masks = _suppressed(masks, (~changed).astype(np.float64), settings)
        streams.append(masks)
    pooled = HierarchicalMasks.concatenate(streams)
    limits = {"iou_max": settings.nms_iou, "score_min": thresholds.nms_score, "inner": settings.nms_inner}
    return suppress_masks(pooled, **limits)


def _suppressed(
    masks: HierarchicalMasks, first: Float64[np.ndarray, " M"] | None, settings: MasksSettings
) -> HierarchicalMasks:
    """Drop masks whose box repeats a better mask's; masks are ranked by `first`, then by predicted IoU."""
    boxes, score, iou_max = masks.box_xyxy, masks.predicted_iou, settings.box_nms_iou
    if settings.generator == "official":
        return masks.take(distinct_boxes(last_inside(boxes), score if first is None else first, iou_max))
    return masks.take(suppress_boxes(boxes, score, iou_max, first))


def _upscale(
    candidates: Candidates,
    rows: Int64[np.ndarray, " m"],
    frame: sam.Frame,
    crop_box: Int32[np.ndarray, " 4"],
    size_hw: tuple[int, int],
    level: Level,
    official: bool,
) -> HierarchicalMasks:
    """Upscale candidates to masks of the view.

    Empty masks are dropped, and so are truncated masks, which touch an edge of their crop that is not an edge
    of the image.
    """
    low_h, low_w = candidates.low_hw.tolist()
    runs, offsets = upscaled_runs(
        candidates.logits,
        candidates.offsets,
        candidates.window_xyxy,
        rows,
        *sam.frame_taps((low_h, low_w), frame),
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
    boxes = last_inside(masks.box_xyxy) if official else masks.box_xyxy
    near_crop = np.abs(boxes - crop_box) <= CROP_EDGE_PX
    near_image = np.abs(boxes - np.array([0, 0, size_hw[1], size_hw[0]])) <= CROP_EDGE_PX
    truncated = (near_crop & ~near_image).any(axis=1)
    return masks.take(np.flatnonzero(~truncated))


def clean_masks(
    masks: HierarchicalMasks, min_area_px: int, keep_small: bool = False
) -> tuple[HierarchicalMasks, Bool[np.ndarray, " m"]]:
    """Fill holes, drop islands (8-connected), and drop masks, if their area is below `min_area_px`.

    The largest island of a mask is always kept. With `keep_small`, masks below `min_area_px` are kept and
    count as changed (SAM). Returns the remaining masks, and which of them were changed.
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
