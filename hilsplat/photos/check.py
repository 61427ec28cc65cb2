"""What is likely to fail with a set of photographs, said before the hours are spent.

Thresholds were chosen on three sets of real photographs that all register, and on copies of them that were
blurred, darkened, over-exposed, or replaced by pictures of a camera that only turns; docs/scene.md has the
measured values.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

FEW_PHOTOS = 10
"""Fewer photographs leave large parts of a scene seen once or never."""

CHECK_SIDE_PX = 800
FEATURE_SIDE_PX = 640
"""Longer side of the grey copies on which blur and light, and motion, are measured."""

BLURRED = 0.55
"""Blur above which a photograph is reported; measured: photographs 0.16 to 0.40, frames of video up to 0.50,
blurred by a Gaussian of 4 px (of 800) 0.58 to 0.77."""

REBLUR_PX = 11

DARK_LEVEL = 64
"""A photograph is dark if 95 % of it is darker. A lit thing before a black wall is not."""

WHITE_LEVEL = 250
WHITE_SHARE = 0.5
"""A photograph is over-exposed if more than this share of it is white."""

SAME_PLACE = 0.01
"""Displacement of matches (90th percentile), as a share of the diagonal, below which two pictures are one.
Not the median: around an object that stays in the centre, half of the matches may hardly move."""

MAX_PAIRS = 60
"""Pairs of neighbours that are matched, spread evenly: at 80 ms a photograph, five seconds."""

NUM_FEATURES = 1000
RATIO = 0.8
MIN_MATCHES = 40
"""Verified matches below which a pair says nothing about motion."""

MATCH_ERROR_PX = 1.5
TURN_ERROR_PX = 3.0
TURN_SHARE = 0.85
"""Share of verified matches that a mere turn explains; measured: turning cameras 0.96 to 1, moving ones 0.07
to 0.27 in the median of a set and 0.87 at most."""

MIN_TURN_PAIRS = 3
FOCALS = (0.6, 0.75, 0.9, 1.1, 1.35, 1.7, 2.2, 3.0)
"""Focal lengths that are tried, in longer sides of the picture."""

NAMED = 5


@dataclass(frozen=True)
class CheckedPhoto:
    """A photograph as the check sees it.

    Attributes:
        name: file name.
        size_hw: height and width, upright, px.
        focal_px: focal length from EXIF, px of the full picture; None if there is none.
        grey: upright grey copy, longer side at most `CHECK_SIDE_PX`.
    """

    name: str
    size_hw: tuple[int, int]
    focal_px: float | None
    grey: UInt8[np.ndarray, "h w"]


def photo_doubts(photos: Sequence[CheckedPhoto], *, have_poses: bool) -> list[str]:
    """Sentences about what is likely to fail and what to do about it; none for a sound set.

    Args:
        photos: readable photographs in the order of their names, which is taken for that of the camera's way.
        have_poses: poses are known, so that only the quality of each photograph matters.
    """
    doubts = []
    if len(photos) < FEW_PHOTOS:
        doubts.append(f"only {len(photos)} photographs: take 20 or more, less than 10 degrees apart")
    doubts += _quality_doubts(photos)
    if not have_poses:
        doubts += _lens_doubts(photos) + _motion_doubts(photos)
    return doubts


def _quality_doubts(photos: Sequence[CheckedPhoto]) -> list[str]:
    doubts = []
    blurred = [photo.name for photo in photos if blur(photo.grey) > BLURRED]
    dark = [photo.name for photo in photos if np.percentile(photo.grey, 95) < DARK_LEVEL]
    white = [photo.name for photo in photos if (photo.grey >= WHITE_LEVEL).mean() > WHITE_SHARE]
    if blurred:
        doubts.append(
            f"{_listed(blurred, photos)} blurred: leave them out, or take them again with "
            "more light, a still hand and the focus on the scene"
        )
    if dark:
        doubts.append(f"{_listed(dark, photos)} too dark: take them again with more light")
    if white:
        doubts.append(
            f"{_listed(white, photos)} more than half white: take them again with less exposure, unless the "
            "background is white"
        )
    return doubts


def _lens_doubts(photos: Sequence[CheckedPhoto]) -> list[str]:
    sizes = sorted({tuple(sorted(photo.size_hw, reverse=True)) for photo in photos}, reverse=True)
    if len(sizes) > 1:
        listed = ", ".join(f"{long} x {short}" for long, short in sizes[:NAMED])
        return [
            f"{len(sizes)} sizes of photographs ({listed}): each size gets its own lens, which few "
            "photographs cannot determine; use one camera, without cropping"
        ]
    focals = sorted(photo.focal_px for photo in photos if photo.focal_px is not None)
    if focals and focals[-1] > 1.1 * focals[0]:
        return [
            f"focal lengths from {focals[0]:.0f} to {focals[-1]:.0f} px: zoom or several lenses; use "
            "one lens, without zooming"
        ]
    return []


def _motion_doubts(photos: Sequence[CheckedPhoto]) -> list[str]:
    """Doubts about the camera's way, from matches of neighbours."""
    last = len(photos) - 1
    rows = sorted(set(np.linspace(0, last - 1, min(last, MAX_PAIRS)).round().astype(int))) if last > 0 else []
    features: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    same, turned, moved = [], 0, 0
    for row in rows:
        for each in (row, row + 1):
            if each not in features:
                features[each] = _features(photos[each].grey)
        motion = pair_motion(features[row], features[row + 1], _feature_size(photos[row].grey))
        features.pop(row)
        if motion is None:
            continue
        if motion.displacement < SAME_PLACE:
            same.append(photos[row + 1].name)
        elif motion.turn_share >= TURN_SHARE:
            turned += 1
        else:
            moved += 1
    doubts = []
    if same:
        doubts.append(
            f"{_listed(same, photos)} nearly the same as the one before: they cost time and add nothing; "
            "leave them out"
        )
    if turned >= MIN_TURN_PAIRS and turned > 2 * moved:
        doubts.append(
            f"the camera seems to turn in place: a rotation explains {turned} of the {turned + moved} "
            "pairs of neighbours that could be compared; depth needs different places: walk around the "
            "scene, or step aside between photographs"
        )
    return doubts


def _listed(names: Sequence[str], photos: Sequence[CheckedPhoto]) -> str:
    """ "3 of 40 photographs (a.jpg, b.jpg, c.jpg) are"."""
    more = ", ..." if len(names) > NAMED else ""
    verb = "is" if len(names) == 1 else "are"
    return f"{len(names)} of {len(photos)} photographs ({', '.join(names[:NAMED])}{more}) {verb}"


# ---- one photograph -------------------------------------------------------------------------------


def blur(grey: UInt8[np.ndarray, "h w"]) -> float:
    """How blurred a picture is, 0 to 1: how little its steps shrink if it is blurred again.

    Crete et al., "The blur effect" (2007), with a box of 11 px: the larger of the values along x and y.
    Unlike the variance of the Laplacian it hardly depends on what the picture shows. A flat picture has 1.
    """
    values = grey.astype(np.float32)
    shares = []
    for axis, box in ((1, (REBLUR_PX, 1)), (0, (1, REBLUR_PX))):
        steps = np.abs(np.diff(values, axis=axis))
        lost = np.maximum(steps - np.abs(np.diff(cv2.blur(values, box), axis=axis)), 0)
        total = float(steps.sum(dtype=np.float64))
        shares.append(1 - float(lost.sum(dtype=np.float64)) / total if total else 1.0)
    return max(shares)


# ---- two photographs ------------------------------------------------------------------------------


@dataclass(frozen=True)
class PairMotion:
    """What verified matches say about the motion between two pictures.

    Attributes:
        displacement: 90th percentile of their displacements, as a share of the diagonal.
        turn_share: share of them that a rotation of the camera about its centre explains.
    """

    displacement: float
    turn_share: float


def _feature_size(grey: UInt8[np.ndarray, "h w"]) -> tuple[int, int]:
    scale = min(1.0, FEATURE_SIDE_PX / max(grey.shape))
    return (round(grey.shape[0] * scale), round(grey.shape[1] * scale))


def _features(
    grey: UInt8[np.ndarray, "h w"],
) -> tuple[Float32[np.ndarray, "n 2"], Float32[np.ndarray, "n 128"]]:
    """SIFT positions in px of the feature size, and RootSIFT descriptors."""
    height, width = _feature_size(grey)
    small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.SIFT.create(NUM_FEATURES).detectAndCompute(small, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    xy = np.array([point.pt for point in points], dtype=np.float32)
    return xy, np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))


def pair_motion(
    one: tuple[Float32[np.ndarray, "n 2"], Float32[np.ndarray, "n 128"]],
    other: tuple[Float32[np.ndarray, "m 2"], Float32[np.ndarray, "m 128"]],
    size_hw: tuple[int, int],
) -> PairMotion | None:
    """Compare two pictures; None if too few matches agree with an epipolar geometry.

    A homography also explains a moving camera before a wall or a carpet (measured: up to 0.97 of the
    matches), so the turn is fitted as a rotation, three numbers, with the best of some focal lengths.
    """
    if min(len(one[0]), len(other[0])) < MIN_MATCHES:
        return None
    nearest: dict[int, cv2.DMatch] = {}
    for pair in cv2.BFMatcher().knnMatch(one[1], other[1], k=2):
        if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance:
            rival = nearest.get(pair[0].trainIdx)
            if rival is None or pair[0].distance < rival.distance:
                nearest[pair[0].trainIdx] = pair[0]
    if len(nearest) < MIN_MATCHES:
        return None
    matches = list(nearest.values())
    a, b = one[0][[match.queryIdx for match in matches]], other[0][[match.trainIdx for match in matches]]
    try:
        _, inliers = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, MATCH_ERROR_PX, 0.999, 2000)
    except cv2.error:  # OpenCV 5.0: no model at all ends in a failed assertion
        return None
    if inliers is None or inliers.sum() < MIN_MATCHES:
        return None
    a, b = a[inliers.ravel() > 0].astype(np.float64), b[inliers.ravel() > 0].astype(np.float64)
    return PairMotion(
        displacement=float(np.percentile(np.linalg.norm(b - a, axis=1), 90) / np.hypot(*size_hw)),
        turn_share=max(_turn_share(a, b, size_hw, focal * max(size_hw)) for focal in FOCALS),
    )


def _turn_share(
    a: Float64[np.ndarray, "n 2"], b: Float64[np.ndarray, "n 2"], size_hw: tuple[int, int], focal_px: float
) -> float:
    """Share of matches that the best rotation explains (Kabsch, refitted to the better half)."""
    centre = np.array([size_hw[1] / 2, size_hw[0] / 2])

    def rays(xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        directions = np.column_stack([(xy - centre) / focal_px, np.ones(len(xy))])
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)

    from_a, from_b = rays(a), rays(b)
    used = np.ones(len(a), dtype=bool)
    for _ in range(5):
        u, _, vt = np.linalg.svd(from_b[used].T @ from_a[used])
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        turned = from_a @ rotation.T
        error_px = np.linalg.norm(turned[:, :2] / turned[:, 2:] * focal_px + centre - b, axis=1)
        used = error_px <= max(TURN_ERROR_PX, float(np.median(error_px)))
    return float((error_px < TURN_ERROR_PX).mean())
