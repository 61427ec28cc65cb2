"""Plain versions, one image at a time, of what the segmenter computes in compiled loops."""

import cv2
import numpy as np

from hilsplat.segment.generate import BAND_PX, Candidates
from hilsplat.segment.sam import LOGIT_STEP


def quantise(logits: np.ndarray) -> np.ndarray:
    """Round logits to steps, clipped to +-127."""
    return np.clip(np.rint(logits / LOGIT_STEP), -127, 127).astype(np.int8)


def flatten_far(steps: np.ndarray) -> np.ndarray:
    """Replace logits farther than `BAND_PX` from a change of sign by +-127."""
    inside = (steps > 0).astype(np.uint8)
    window = np.ones((2 * BAND_PX + 1, 2 * BAND_PX + 1), np.uint8)
    band = (cv2.dilate(inside, window) > 0) & (cv2.erode(inside, window) == 0)
    return np.where(band, steps, np.where(steps > 0, 127, -127)).astype(np.int8)


def unpacked(candidates: Candidates) -> np.ndarray:
    """All candidates' logits as whole images."""
    out = np.full((len(candidates), *candidates.low_hw), -127, np.int8)
    for row, (x0, y0, x1, y1) in enumerate(candidates.window_xyxy):
        values = candidates.logits[candidates.offsets[row] : candidates.offsets[row + 1]]
        out[row, y0:y1, x0:x1] = values.reshape(y1 - y0, x1 - x0)
    return out


def smooth_logits(count: int, side: int, seed: int) -> np.ndarray:
    """Random hills and valleys, float32 (count, side, side)."""
    noise = np.random.default_rng(seed).normal(size=(count, side, side)).astype(np.float32)
    return np.stack([36 * cv2.GaussianBlur(one, (0, 0), 3) for one in noise])
