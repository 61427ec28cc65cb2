"""Metrics that compare one predicted mask with one true region."""

import math

import numpy as np
from jaxtyping import Bool, Float

BOUNDARY_RATIO = 0.02
"""Width of a boundary as a share of the image diagonal (Cheng et al. 2021)."""


def iou(prediction: Bool[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"]) -> float:
    """Return intersection over union; 0 for two empty masks, as in OpenGaussian's script."""
    union = np.count_nonzero(prediction | truth)
    return np.count_nonzero(prediction & truth) / union if union else 0.0


def boundary_width_px(size_hw: tuple[int, int], ratio: float = BOUNDARY_RATIO) -> int:
    """Return the width of the boundary band: a share of the diagonal, rounded half to even, at least 1 px."""
    return max(1, round(ratio * math.hypot(*size_hw)))


def boundary(mask: Bool[np.ndarray, "H W"], width_px: int) -> Bool[np.ndarray, "H W"]:
    """Return the pixels of the mask that an erosion by `width_px` removes.

    Outside the image counts as background, so mask pixels along the image border are boundary. One
    erosion with a square of 2 width + 1 px equals `width_px` erosions with a 3 x 3 square.
    """
    import cv2

    side = 2 * width_px + 1
    eroded = cv2.erode(
        mask.astype(np.uint8),
        np.ones((side, side), np.uint8),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=(0.0,),
    )
    return mask & (eroded == 0)


def boundary_iou(
    prediction: Bool[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"], ratio: float = BOUNDARY_RATIO
) -> float:
    """Return the IoU of the two boundaries (Cheng et al. 2021, as in lkeab/gaussian-grouping)."""
    width_px = boundary_width_px(truth.shape, ratio)
    return iou(boundary(prediction, width_px), boundary(truth, width_px))


def best_threshold_iou(score: Float[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"]) -> float:
    """Return the largest IoU that any threshold on the score map could give.

    This diagnostic uses the truth: it separates a wrong ranking of pixels from a wrong threshold. It is
    exact: lowering the threshold between two scores of true pixels only adds false ones, so testing the
    scores of true pixels is sufficient.
    """
    inside, outside = np.sort(score[truth]), np.sort(score[~truth])
    cuts = np.unique(inside)
    hits = inside.size - np.searchsorted(inside, cuts)
    false = outside.size - np.searchsorted(outside, cuts)
    return float((hits / (inside.size + false)).max()) if cuts.size else 0.0


def exceeds(prediction: Bool[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"], threshold: float) -> float:
    """Return 1 if the IoU exceeds the threshold, else 0; the mean over pairs is Acc@0.25 or Acc@0.5.

    Source: yanmin-wu/OpenGaussian `scripts/compute_lerf_iou.py`.
    """
    return float(iou(prediction, truth) > threshold)
