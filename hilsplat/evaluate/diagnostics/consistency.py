"""Measure how often the same surface point is in different masks in neighbouring views.

The same functions apply to masks from any source (a segmenter, rendered answers, the truth). Their input is
boolean masks of two views and the points visible in both, from exact geometry or any reliable depth.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, Int64

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.scene.cameras import Camera, Cameras

DEPTH_TOLERANCE = 0.01
"""Two views show the same point if its depths differ by at most this share."""

MIN_POINTS = 16
"""Masks with fewer shared points are not compared."""

MAX_POINTS = 50_000
"""Maximum number of shared points per pair of views; more are evenly subsampled."""


@dataclass(frozen=True)
class SharedPoints:
    """Surface points visible in both of two views, as pixels.

    Attributes:
        pixel_a: row-major pixel index in view A; each pixel of A at most once.
        pixel_b: the pixel of view B that contains the point's projection.
    """

    pixel_a: Int64[np.ndarray, " P"]
    pixel_b: Int64[np.ndarray, " P"]

    def __len__(self) -> int:
        return len(self.pixel_a)


@dataclass(frozen=True)
class Agreement:
    """Agreement of the masks of one level between views. Empty comparisons are nan.

    Attributes:
        pairs: number of ordered pairs of views (A, B) compared.
        masks: number of masks of A compared over all pairs.
        best_iou: highest IoU of a mask of A with any mask of B, counted in shared points (0 if B has no
            mask), averaged over the masks of A and then over pairs. 1 is perfect.
        disagreement: share of all pairs of shared points (p, q) that are in the same mask in one view and
            not in the other (1 minus the Rand index), mean over pairs of views. 0 is perfect. If most pairs
            of points are in different masks in both views, it is small for any masks.
        joined_disagreement: the same share among pairs of points that are in the same mask in at least one
            view (a Jaccard distance of the two relations). 0 is perfect; 1 means that no pair of points is
            in the same mask in both views.
    """

    pairs: int
    masks: int
    best_iou: float
    disagreement: float
    joined_disagreement: float


def shared_points(
    camera_a: Camera,
    depth_a: Float[np.ndarray, "Ha Wa"],
    camera_b: Camera,
    depth_b: Float[np.ndarray, "Hb Wb"],
    tolerance: float = DEPTH_TOLERANCE,
) -> SharedPoints:
    """Return the points of view A's pixel centres that are also visible in view B.

    A point is lifted by A's depth and projected into B. It is visible there if B's depth at the projection
    equals its own up to `tolerance`. B's depth between pixel centres is interpolated as inverse depth, which
    is exact on planes of any slant; next to a depth jump the interpolated value belongs to neither side, so
    points at occluding borders are dropped.

    Args:
        depth_a: depth along A's optical axis at the pixel centres, scene units; inf without a surface.
        depth_b: the same for B.
        tolerance: maximum relative difference in depth.
    """
    pixel = np.flatnonzero(np.isfinite(depth_a))
    depth = depth_a.reshape(-1)[pixel].astype(np.float64)
    width_a = depth_a.shape[1]
    centres = np.stack([pixel % width_a + 0.5, pixel // width_a + 0.5, np.ones(len(pixel))], axis=1)
    in_a = centres @ np.linalg.inv(camera_a.K).T * depth[:, None]
    b_from_a = camera_b.cam_from_world @ np.linalg.inv(camera_a.cam_from_world)
    in_b = in_a @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    ahead = in_b[:, 2] > 1e-9 * depth
    pixel, in_b = pixel[ahead], in_b[ahead]
    projected = in_b @ camera_b.K.T
    xy = projected[:, :2] / projected[:, 2:]
    height, width = depth_b.shape
    # The four pixel centres around the projection must be in the image.
    low = np.floor(xy - 0.5)
    whole = (low >= 0).all(axis=1) & (low[:, 0] + 1 < width) & (low[:, 1] + 1 < height)
    pixel, in_b, xy, low = pixel[whole], in_b[whole], xy[whole], low[whole].astype(np.int64)
    share_x, share_y = (xy - 0.5 - low).T
    inverse = 1 / depth_b.astype(np.float64)
    x, y = low.T
    upper = inverse[y, x] * (1 - share_x) + inverse[y, x + 1] * share_x
    lower = inverse[y + 1, x] * (1 - share_x) + inverse[y + 1, x + 1] * share_x
    shown = upper * (1 - share_y) + lower * share_y
    visible = np.abs(shown * in_b[:, 2] - 1) <= tolerance
    x, y = np.floor(xy[visible]).astype(np.int64).T
    return SharedPoints(pixel[visible], y * width + x)


def thinned(points: SharedPoints, most: int = MAX_POINTS) -> SharedPoints:
    """Return at most `most` of the points, evenly subsampled in order."""
    if len(points) <= most:
        return points
    kept = np.linspace(0, len(points) - 1, most).astype(np.int64)
    return SharedPoints(points.pixel_a[kept], points.pixel_b[kept])


def best_ious(
    inside_a: Bool[np.ndarray, "Ma P"], inside_b: Bool[np.ndarray, "Mb P"], min_points: int = MIN_POINTS
) -> Float[np.ndarray, " m"]:
    """Return, for each mask of A with enough shared points, the highest IoU with a mask of B, in points."""
    a = inside_a[inside_a.sum(axis=1) >= min_points].astype(np.float32)  # counts exactly up to 2**24
    b = inside_b.astype(np.float32)
    if not len(b):
        return np.zeros(len(a))
    both = (a @ b.T).astype(np.float64)
    union = a.sum(axis=1, dtype=np.float64)[:, None] + b.sum(axis=1, dtype=np.float64)[None, :] - both
    return (both / union).max(axis=1)


def pair_disagreement(
    labels_a: Int[np.ndarray, " P"], labels_b: Int[np.ndarray, " P"]
) -> tuple[float, float]:
    """Return the shares of pairs of points that are in the same mask in one view and not in the other.

    Args:
        labels_a: mask of each point in A, -1 for none: such a point shares its mask with no other.
        labels_b: mask of each point in B, -1 for none.

    Returns:
        The share among all pairs of points, and among those in the same mask in at least one view; nan if
        there is no such pair. All pairs are counted, via the contingency table of the labels.
    """
    rows = np.unique(labels_a, return_inverse=True)[1]
    names, columns = np.unique(labels_b, return_inverse=True)
    in_mask = (labels_a != NONE) & (labels_b != NONE)
    cells = np.bincount((rows * max(1, len(names)) + columns)[in_mask])
    together_a = _pairs(np.bincount(rows[labels_a != NONE]))
    together_b = _pairs(np.bincount(columns[labels_b != NONE]))
    both = _pairs(cells)
    differ, all_pairs = together_a + together_b - 2 * both, _pairs(np.array([len(labels_a)]))
    either = differ + both
    return (
        differ / all_pairs if all_pairs else float("nan"),
        differ / either if either else float("nan"),
    )


def _pairs(counts: Int[np.ndarray, " n"]) -> int:
    """Return the number of pairs within groups of the given sizes."""
    counts = counts.astype(np.int64)
    return int((counts * (counts - 1) // 2).sum())


def painted(inside: Bool[np.ndarray, "M P"], area_px: Int[np.ndarray, " M"]) -> Int32[np.ndarray, " P"]:
    """Return the mask at each point, -1 for none: masks are painted from large to small, as in a label map.

    Of two equally large masks the one in the lower row is painted last.
    """
    labels = np.full(inside.shape[1], NONE, dtype=np.int32)
    for row in np.lexsort((-np.arange(len(area_px)), -area_px)):
        labels[inside[row]] = row
    return labels


def view_agreement(
    masks_a: Bool[np.ndarray, "Ma Ha Wa"],
    masks_b: Bool[np.ndarray, "Mb Hb Wb"],
    points: SharedPoints,
) -> Agreement:
    """Return the agreement of the masks of one level between two views.

    Masks of a view may overlap. `best_iou` uses them as they are, the disagreements use the smallest mask at
    each point (`painted`), like the language field.
    """
    inside_a = masks_a.reshape(len(masks_a), np.prod(masks_a.shape[1:], dtype=int))[:, points.pixel_a]
    inside_b = masks_b.reshape(len(masks_b), np.prod(masks_b.shape[1:], dtype=int))[:, points.pixel_b]
    ious = best_ious(inside_a, inside_b)
    all_pairs, joined = pair_disagreement(
        painted(inside_a, masks_a.sum(axis=(1, 2))), painted(inside_b, masks_b.sum(axis=(1, 2)))
    )
    best = float(ious.mean()) if len(ious) else float("nan")
    return Agreement(1, len(ious), best, all_pairs, joined)


def mean_agreement(parts: Sequence[Agreement]) -> Agreement:
    """Sum the counts, and average the shares over the pairs of views in which they are defined."""

    def mean(name: str) -> float:
        values = [getattr(part, name) for part in parts]
        values = [value for value in values if value == value]
        return sum(values) / len(values) if values else float("nan")

    return Agreement(
        sum(part.pairs for part in parts),
        sum(part.masks for part in parts),
        mean("best_iou"),
        mean("disagreement"),
        mean("joined_disagreement"),
    )


def neighbours(cameras: Cameras, views: Sequence[str], count: int) -> list[tuple[str, str]]:
    """Return ordered pairs (A, B): each view with the `count` other views whose cameras are nearest.

    The earlier one in `views` wins ties.
    """
    centres = np.array([cameras[view].centre for view in views])
    pairs = []
    for row, view in enumerate(views):
        apart = np.linalg.norm(centres - centres[row], axis=1)
        apart[row] = np.inf
        nearest = np.argsort(apart, kind="stable")[: min(count, len(views) - 1)]
        pairs += [(view, views[other]) for other in nearest]
    return pairs


def measure_consistency(
    cameras: Cameras,
    pairs: Iterable[tuple[str, str]],
    depth_of: Callable[[str], Float[np.ndarray, "H W"]],
    masks_of: Callable[[str, Level], Bool[np.ndarray, "M H W"]],
) -> dict[Level, Agreement]:
    """Return the agreement of the masks of each level over pairs of views.

    Args:
        cameras: cameras of the views, in the frame of the depths.
        pairs: ordered pairs of view names (see `neighbours`).
        depth_of: depth of a view at its pixel centres; inf without a surface.
        masks_of: masks of a view at a level.
    """
    found: dict[Level, list[Agreement]] = {level: [] for level in LEVELS}
    for a, b in pairs:
        points = thinned(shared_points(cameras[a], depth_of(a), cameras[b], depth_of(b)))
        for level in LEVELS:
            found[level].append(view_agreement(masks_of(a, level), masks_of(b, level), points))
    return {level: mean_agreement(parts) for level, parts in found.items()}
