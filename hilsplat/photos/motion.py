"""How sharp a picture is, and how far two pictures of one camera are apart."""

import cv2
import numpy as np
from jaxtyping import UInt8

NUM_CORNERS = 300
PYRAMID_LEVELS = 4
LOST = 0.25
"""Displacement, as a share of the diagonal, of pictures in which no corner could be followed."""

MIN_FOLLOWED = 20
"""Corners that must be followed there and back; fewer say nothing."""


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Variance of the Laplacian (Pech-Pacheco et al. 2000): large where edges are steep.

    It compares pictures of the same place; between places it depends on what they show.
    """
    return float(cv2.Laplacian(grey, cv2.CV_32F, ksize=3).var())


def displacement(one: UInt8[np.ndarray, "h w"], other: UInt8[np.ndarray, "h w"]) -> float:
    """How far corners moved between two pictures, as a share of the diagonal: their upper quartile.

    Corners are followed by pyramidal Lucas-Kanade, there and back; those that miss their start by a pixel do
    not count. The upper quartile, not the median, so that an object on a turntable counts before a still
    background. If too few corners can be followed, the result is `LOST`, or 0 for pictures without corners.
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
    """Where corners of one picture are in the other, (n, 1, 2), and which of them were found, (n)."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, corners, np.zeros_like(corners), maxLevel=PYRAMID_LEVELS
    )
    return np.asarray(there), np.asarray(found).ravel() > 0
