"""What the networks say about a view: the costly half of automatic mask generation, which is cached."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Int8, Int32, UInt8

from hilsplat.base import onnx_models
from hilsplat.base.artifacts import sha256_of_file, sha256_of_json
from hilsplat.segment import sam
from hilsplat.segment.sam import HEADS, SamModel, point_grid, stability_of
from hilsplat.settings import MasksSettings

LOOSE = 0.1
"""Masks below this predicted IoU or stability, or below a lower threshold of the settings, are not cached."""

BAND_PX = 3
"""Low-resolution pixels on either side of a mask's edge whose logits are kept (see `flatten_far`)."""

CROP_OVERLAP = 512 / 1500
"""Overlap of the first layer's crops, as a share of the image's shorter side (SAM)."""


@dataclass(frozen=True)
class Candidates:
    """K masks as the decoder gave them, before any threshold that a user may want to turn.

    Attributes:
        logits: low-resolution logits in steps of `sam.LOGIT_STEP`, flat far from a mask's edge.
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


def crop_boxes(
    size_hw: tuple[int, int], layers: int
) -> tuple[Int32[np.ndarray, "C 4"], UInt8[np.ndarray, " C"]]:
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
    code.append(sha256_of_file(Path(__file__)))
    return sha256_of_json(
        {
            "image": image_sha256,
            "model": model.digest,
            "providers": model.encoder.providers,
            "points_per_side": settings.points_per_side,
            "points_per_batch": model.prompts_per_call(
                settings.points_per_batch, settings.points_per_side**2
            ),
            "crop_layers": settings.crop_layers,
            "stability_offset": settings.stability_offset,
            "floors": floors(settings),
            "code": code,
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
    grid = point_grid(settings.points_per_side)
    batch = model.prompts_per_call(settings.points_per_batch, len(grid))
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
                (
                    flatten_far(steps[keep]),
                    head[keep],
                    scores[keep],
                    stability[keep],
                    np.full(keep.sum(), crop, np.uint8),
                )
            )
    return Candidates(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def flatten_far(logits: Int8[np.ndarray, "K h w"]) -> Int8[np.ndarray, "K h w"]:
    """Set logits that lie farther than `BAND_PX` from a change of sign to the extreme of their sign.

    The two bilinear resizings up to the view read logits at most three pixels apart, so every pixel
    of every mask stays what it was; what is left is constant almost everywhere and packs ten times
    smaller.
    """
    extreme = np.iinfo(np.int8).max
    window = np.ones((2 * BAND_PX + 1, 2 * BAND_PX + 1), np.uint8)
    flat = np.where(logits > 0, extreme, -extreme).astype(np.int8)
    for row, mask in enumerate(logits > 0):
        inside = mask.astype(np.uint8)
        band = (cv2.dilate(inside, window) > 0) & (cv2.erode(inside, window) == 0)
        flat[row][band] = logits[row][band]
    return flat
