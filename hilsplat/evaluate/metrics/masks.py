"""Metrics that compare predicted masks with true regions."""

import math

import numpy as np
from jaxtyping import Bool, Float

BOUNDARY_RATIO = 0.02
"""Width of a boundary as a share of the image diagonal (Cheng et al. 2021)."""


def iou(prediction: Bool[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"]) -> float:
    """Return intersection over union; 0 for two empty masks, as in OpenGaussian's script."""
    union = np.count_nonzero(prediction | truth)
    return np.count_nonzero(prediction & truth) / union if union else 0.0


def boundary_width_px(size_hw: tuple[int, int]) -> int:
    """Return the width of the boundary band: a share of the diagonal, rounded half to even, at least 1 px."""
    return max(1, round(BOUNDARY_RATIO * math.hypot(*size_hw)))


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


def boundary_iou(prediction: Bool[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"]) -> float:
    """Return the IoU of the two boundaries (Cheng et al. 2021, as in lkeab/gaussian-grouping)."""
    width_px = boundary_width_px(truth.shape)
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


def argmax_masks(similarity: Float[np.ndarray, "K H W"]) -> Bool[np.ndarray, "K H W"]:
    """Return one mask per class, the pixels where its similarity is largest: 3D-OVS's original protocol.

    The first class wins ties; a pixel whose similarities are all -inf has no class. The IoU of a class absent
    from prediction and truth is 0 (the default of scikit-learn, used by that code).
    Source: Kunhao-Liu/3D-OVS `renderer.py`.

    Args:
        similarity: cosine of each pixel's feature with each class text, without template or canonical
            phrases. Classes are in the order of the sorted texts, which determines ties.
    """
    winner = similarity.argmax(axis=0)
    answered = similarity.max(axis=0) > -np.inf
    return (winner[None] == np.arange(len(similarity))[:, None, None]) & answered


def pixel_accuracy(prediction: Bool[np.ndarray, "K H W"], truth: Bool[np.ndarray, "K H W"]) -> float:
    """Return the share of pixels whose classes are exactly the true ones.

    A pixel with two true classes or none is never correct, because the prediction has one.
    """
    return float((prediction == truth).all(axis=0).mean())
