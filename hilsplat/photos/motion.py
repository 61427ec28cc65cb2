"""Sharpness of a picture, and displacement between two pictures of one camera."""

import cv2
import numpy as np
from jaxtyping import UInt8

NUM_CORNERS = 300
PYRAMID_LEVELS = 4
LOST = 0.25
"""Displacement, as a share of the diagonal, assumed if too few corners can be tracked."""

MIN_FOLLOWED = 20
"""Minimum number of corners tracked forwards and backwards for a valid measurement."""


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Compute the variance of the Laplacian (Pech-Pacheco et al. 2000), which is large for steep edges.

    It can compare pictures of the same place only, because it depends on the content.
    """
    return float(cv2.Laplacian(grey, cv2.CV_32F, ksize=3).var())


def displacement(one: UInt8[np.ndarray, "h w"], other: UInt8[np.ndarray, "h w"]) -> float:
    """Return the upper quartile of corner displacements between two pictures, as a share of the diagonal.

    Corners are tracked forwards and backwards with pyramidal Lucas-Kanade; those that miss their start by a
    pixel are ignored. Unlike the median, the upper quartile captures an object on a turntable before a static
    background. The result is 0 for pictures with too few corners, and `LOST` if too few can be tracked.
    """
    corners = cv2.goodFeaturesToTrack(one, NUM_CORNERS, qualityLevel=0.01, minDistance=7)
    if corners is None or len(corners) < MIN_FOLLOWED:
        return 0.0
    there, found = _followed(one, other, corners)
    back, returned = _followed(other, one, there)
    sound = found & returned & (np.linalg.norm(back - corners, axis=2).ravel() < 1)
    if sound.sum() < MIN_FOLLOWED:
        return LOST
    moved = np.linalg.norm((there - corners)[sound].reshape(-1, 2), axis=1)
    return float(np.percentile(moved, 75) / np.hypot(*one.shape))


def _followed(
    one: UInt8[np.ndarray, "h w"], other: UInt8[np.ndarray, "h w"], corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of corners in the other picture, (n, 1, 2), and whether each was found, (n)."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, corners, np.zeros_like(corners), maxLevel=PYRAMID_LEVELS
    )
    return np.asarray(there), np.asarray(found).ravel() > 0
