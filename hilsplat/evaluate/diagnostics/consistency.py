"""How often the same surface point gets different masks in neighbouring views.

The same functions measure masks from any source (a segmenter, rendered answers, the truth): they take
boolean masks of two views and the points that both views show. The points come from exact geometry or from
any trusted depth; nothing here depends on which.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, Int64

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.scene.cameras import Camera, Cameras

DEPTH_TOLERANCE = 0.01
"""Two views show the same point if their depths of it differ by at most this share."""

MIN_POINTS = 16
"""Masks with fewer shared points are not compared."""

MAX_POINTS = 50_000
"""Shared points of a pair of views beyond this number are thinned out evenly."""


@dataclass(frozen=True)
class SharedPoints:
    """Surface points that two views both show, as the pixels that show them.

    Attributes:
        pixel_a: row-major pixel index in view A; each pixel of A at most once.
        pixel_b: the pixel of view B that holds the point's projection.
    """

    pixel_a: Int64[np.ndarray, " P"]
    pixel_b: Int64[np.ndarray, " P"]

    def __len__(self) -> int:
        return len(self.pixel_a)


@dataclass(frozen=True)
class Agreement:
    """How well the masks of one level agree between views. Empty comparisons are nan.

    Attributes:
        pairs: ordered pairs of views (A, B) compared.
        points: shared points, all pairs together.
        masks: masks of A compared, all pairs together.
        best_iou: mean, over the masks of A and then over pairs, of the highest IoU of the mask with a mask
            of B, counted in shared points; 0 if B has no mask. 1 is perfect.
        disagreement: share of all pairs of shared points (p, q) that lie in the same mask in one view and
            not in the other (1 minus the Rand index), mean over pairs of views. 0 is perfect. If most pairs
            of points lie in different masks in both views, it is small whatever the masks.
        joined_disagreement: the same among the pairs of points that lie in the same mask in at least one
            of the two views (a Jaccard distance of the two relations). 0 is perfect, 1 means that the
            views have no joined pair in common.
    """

    pairs: int
    points: int
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
    """Points of view A's pixel centres that view B shows too.

    A point is lifted by A's depth and projected into B. It counts as visible there if B's depth at the
    projection equals its own up to `tolerance`. B's depth between pixel centres is interpolated as inverse
    depth, which is exact on planes, however slanted; next to a depth jump the interpolated value belongs to
    neither side, so points at occluding borders drop out.

    Args:
        camera_a: camera of view A.
        depth_a: depth along A's optical axis at the pixel centres, scene units; inf without a surface.
        camera_b: camera of view B.
        depth_b: the same for B.
        tolerance: largest relative difference in depth.
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
    # the four pixel centres around the projection must lie in the image
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
    """At most `most` of the points, evenly spread over their order."""
    if len(points) <= most:
        return points
    kept = np.linspace(0, len(points) - 1, most).astype(np.int64)
    return SharedPoints(points.pixel_a[kept], points.pixel_b[kept])


def best_ious(
    inside_a: Bool[np.ndarray, "Ma P"], inside_b: Bool[np.ndarray, "Mb P"], min_points: int = MIN_POINTS
) -> Float[np.ndarray, " m"]:
    """For each mask of A with enough shared points the highest IoU with a mask of B, counted in points.

    Args:
        inside_a: which shared points lie in which mask of A.
        inside_b: the same for B.
        min_points: masks of A with fewer points are left out.
    """
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
    """Share of pairs of points that are in one mask together in one view and not in the other.

    Args:
        labels_a: mask of each point in A, -1 for none: such a point shares its mask with no other.
        labels_b: the same for B.

    Returns:
        the share among all pairs of points, and among those together in at least one view; nan if there is
        no such pair. All pairs count; the contingency table of the labels gives their number.
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
    """Pairs within groups of the given sizes."""
    counts = counts.astype(np.int64)
    return int((counts * (counts - 1) // 2).sum())


def painted(inside: Bool[np.ndarray, "M P"], area_px: Int[np.ndarray, " M"]) -> Int32[np.ndarray, " P"]:
    """Mask at each point, -1 for none: masks are painted from large to small, as in a label map.

    Of two equally large masks the lower row is painted last.
    """
    labels = np.full(inside.shape[1], NONE, dtype=np.int32)
    for row in np.lexsort((-np.arange(len(area_px)), -area_px)):
        labels[inside[row]] = row
    return labels


def view_agreement(
    masks_a: Bool[np.ndarray, "Ma Ha Wa"],
    masks_b: Bool[np.ndarray, "Mb Hb Wb"],
    points: SharedPoints,
    min_points: int = MIN_POINTS,
) -> Agreement:
    """How well the masks of one level agree between two views.

    Args:
        masks_a: masks of view A, which may overlap. `best_iou` takes them as they are, the disagreements take
            the smallest mask at each point (`painted`), as the language field does.
        masks_b: masks of view B.
        points: points that both views show.
        min_points: masks of A with fewer shared points are not compared.
    """
    inside_a = masks_a.reshape(len(masks_a), np.prod(masks_a.shape[1:], dtype=int))[:, points.pixel_a]
    inside_b = masks_b.reshape(len(masks_b), np.prod(masks_b.shape[1:], dtype=int))[:, points.pixel_b]
    ious = best_ious(inside_a, inside_b, min_points)
    all_pairs, joined = pair_disagreement(
        painted(inside_a, masks_a.sum(axis=(1, 2))), painted(inside_b, masks_b.sum(axis=(1, 2)))
    )
    best = float(ious.mean()) if len(ious) else float("nan")
    return Agreement(1, len(points), len(ious), best, all_pairs, joined)


def mean_agreement(parts: Sequence[Agreement]) -> Agreement:
    """Counts summed, shares averaged over the pairs of views in which they are defined."""

    def mean(name: str) -> float:
        values = [getattr(part, name) for part in parts]
        values = [value for value in values if value == value]
        return sum(values) / len(values) if values else float("nan")

    return Agreement(
        sum(part.pairs for part in parts),
        sum(part.points for part in parts),
        sum(part.masks for part in parts),
        mean("best_iou"),
        mean("disagreement"),
        mean("joined_disagreement"),
    )


def neighbours(cameras: Cameras, views: Sequence[str], count: int) -> list[tuple[str, str]]:
    """Ordered pairs (A, B): for each view the `count` other views whose cameras are nearest.

    Ties go to the earlier one in `views`.
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
    tolerance: float = DEPTH_TOLERANCE,
) -> dict[Level, Agreement]:
    """Agreement of the masks of each level over pairs of views.

    Args:
        cameras: cameras of the views, in the frame of the depths.
        pairs: ordered pairs of view names (see `neighbours`).
        depth_of: depth of a view at its pixel centres; inf without a surface.
        masks_of: masks of a view at a level.
        tolerance: see `shared_points`.
    """
    found: dict[Level, list[Agreement]] = {level: [] for level in LEVELS}
    for a, b in pairs:
        points = thinned(shared_points(cameras[a], depth_of(a), cameras[b], depth_of(b), tolerance))
        for level in LEVELS:
            found[level].append(view_agreement(masks_of(a, level), masks_of(b, level), points))
    return {level: mean_agreement(parts) for level, parts in found.items()}
