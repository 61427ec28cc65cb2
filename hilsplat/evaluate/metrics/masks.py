"""Metrics for masks (against ground-truth regions) and for localization (map peaks on the object)."""

import math

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

BOUNDARY_RATIO = 0.02  # boundary width as a fraction of the image diagonal (Cheng et al. 2021).


def iou(prediction: Bool[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"]) -> float:
    """Return intersection over union; 0 for two empty masks, as in OpenGaussian's script."""
    union = np.count_nonzero(prediction | truth)
    return np.count_nonzero(prediction & truth) / union if union else 0.0


def iou_matrix(
    regions: Bool[np.ndarray, "R P"], masks: Bool[np.ndarray, "M P"]
) -> Float64[np.ndarray, "R M"]:
    """Return the IoU of every region with every mask, 0 if both are empty; regions or masks may overlap."""
    shared = regions.astype(np.float32) @ masks.T.astype(np.float32)  # counts exactly up to 2**24 px
    union = regions.sum(axis=1)[:, None] + masks.sum(axis=1)[None] - shared
    return np.divide(shared, union, out=np.zeros(shared.shape), where=union > 0)


def boundary_width_px(size_hw: tuple[int, int]) -> int:
    """Return the width of the boundary band: a fraction of the diagonal, rounded half to even, at least 1."""
    return max(1, round(BOUNDARY_RATIO * math.hypot(*size_hw)))


def boundary(mask: Bool[np.ndarray, "H W"], width_px: int) -> Bool[np.ndarray, "H W"]:
    """Return the pixels of the mask that an erosion by `width_px` removes.

    The outside of the image counts as background, so mask pixels along the image border are boundary.
    """
    import cv2

    kernel = np.ones((2 * width_px + 1, 2 * width_px + 1), np.uint8)
    eroded = cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,))
    return mask & (eroded == 0)


def boundary_iou(prediction: Bool[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"]) -> float:
    """Return the IoU of the two boundaries (Cheng et al. 2021, as in lkeab/gaussian-grouping)."""
    width_px = boundary_width_px(truth.shape)
    return iou(boundary(prediction, width_px), boundary(truth, width_px))


def best_threshold_iou(score: Float[np.ndarray, "H W"], truth: Bool[np.ndarray, "H W"]) -> float:
    """Return the largest IoU over all thresholds on the score map: a diagnostic that uses the ground truth.

    Testing the scores of ground-truth pixels is sufficient: other thresholds only add false positives.
    """
    inside, outside = np.sort(score[truth]), score[~truth]
    if not inside.size:
        return 0.0
    outside = np.sort(outside[outside >= inside[0]])  # the others, mostly nine of ten, are above no threshold
    cuts = np.unique(inside)
    hits = inside.size - np.searchsorted(inside, cuts)
    false = outside.size - np.searchsorted(outside, cuts)
    return float((hits / (inside.size + false)).max())


def argmax_masks(similarity: Float[np.ndarray, "K H W"]) -> Bool[np.ndarray, "K H W"]:
    """Return one mask per class: the pixels where its cosine is largest (Kunhao-Liu/3D-OVS `renderer.py`).

    The first class wins ties; a pixel whose values are all -inf has no class. The IoU of a class absent from
    prediction and ground truth is 0 (scikit-learn's default, used by `renderer.py`).
    """
    winner = similarity.argmax(axis=0)
    answered = similarity.max(axis=0) > -np.inf
    return (winner[None] == np.arange(len(similarity))[:, None, None]) & answered


def pixel_accuracy(prediction: Bool[np.ndarray, "K H W"], truth: Bool[np.ndarray, "K H W"]) -> float:
    """Return the share of pixels whose predicted classes exactly match the ground truth.

    A pixel with zero or two ground-truth classes is never correct, because the prediction has one class.
    """
    return float((prediction == truth).all(axis=0).mean())


def peak_points(filtered: Float[np.ndarray, "L H W"]) -> Int[np.ndarray, "P 2"]:
    """Return all pixels (x, y) at which the filtered maps of levels have their maximum.

    The map with the highest maximum is used; the finest level wins ties, as in LangSplat.
    """
    chosen = max(filtered[::-1], key=np.max)
    pixels = np.flatnonzero(chosen == chosen.max())  # np.nonzero in two dimensions is six times slower
    return np.stack([pixels % chosen.shape[1], pixels // chosen.shape[1]], axis=1)


def hits_a_box(points_xy: Int[np.ndarray, "P 2"], boxes_xyxy: Int[np.ndarray, "B 4"]) -> bool:
    """Return whether any point is in any box, borders included (x1 <= x <= x2), as in LERF."""
    x, y = points_xy[:, None, 0], points_xy[:, None, 1]
    x1, y1, x2, y2 = (boxes_xyxy[None, :, side] for side in range(4))
    return bool(((x1 <= x) & (x <= x2) & (y1 <= y) & (y <= y2)).any())


def hits_the_mask(points_xy: Int[np.ndarray, "P 2"], truth: Bool[np.ndarray, "H W"]) -> bool:
    """Return whether any point is in the ground-truth region, which is stricter than the box."""
    return bool(truth[points_xy[:, 1], points_xy[:, 0]].any())
