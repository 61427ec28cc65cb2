"""The coverage tree of a view: which mask lies in which (paper, Sec. III-B)."""

import numpy as np
from jaxtyping import Bool, Int32, Int64, UInt8

from hilsplat.base.errors import EmptyMaskError
from hilsplat.base.levels import NONE
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import CoverageTreeSettings


def coverage_parents(
    masks: Bool[np.ndarray, "M H W"], theta: float, level: UInt8[np.ndarray, " M"] | None = None
) -> Int32[np.ndarray, " M"]:
    """Find the parent of every mask of one view (paper, Sec. III-B).

    Mask `a` is a child of mask `b` when more than `theta` of `a` lies in `b` while less
    than `theta` of `b` lies in `a`. The smallest such `b` is the parent; of two equally
    small ones, the lower row.

    Args:
        masks: one mask per row, none empty. Masks may overlap.
        theta: coverage threshold, a share in (0, 1); the paper uses 0.9.
        level: where given, a parent must stand at a coarser level than its child; a subpart may
            hang directly under a whole. The paper leaves this open; without it two masks of one
            level can be parent and child.

    Returns:
        Row of each mask's parent, or `NONE` where no mask covers it.

    Raises:
        EmptyMaskError: a row has no pixel, so its coverage is undefined.

    Example:
        >>> whole, part = [[1, 1, 1, 1]], [[1, 1, 0, 0]]
        >>> coverage_parents(np.array([whole, part], dtype=bool), theta=0.9)
        array([-1,  0], dtype=int32)
    """
    pixels = masks.reshape(len(masks), masks.shape[1] * masks.shape[2]).astype(np.float32)
    # float32 counts exactly up to 2**24 px per mask, beyond any image we read.
    return parents_from_overlaps((pixels @ pixels.T).astype(np.int64), theta, level)


def parents_from_overlaps(
    overlap_px: Int64[np.ndarray, "M M"], theta: float, level: UInt8[np.ndarray, " M"] | None = None
) -> Int32[np.ndarray, " M"]:
    """`coverage_parents` from the pixels that each pair of masks shares."""
    area_px = np.diagonal(overlap_px)
    if not area_px.all():
        empty = np.flatnonzero(area_px == 0).tolist()
        raise EmptyMaskError(
            f"masks {empty} of {len(area_px)} have no pixel",
            fix="drop empty masks before building the coverage tree",
        )
    if not len(area_px):
        return np.zeros(0, dtype=np.int32)
    share = overlap_px / area_px[:, None]  # [a, b]: share of a inside b
    covered = (share > theta) & (share < theta).T
    if level is not None:
        covered &= level[None, :] < level[:, None]
    # covered[a, b] implies area[a] < area[b]: chains of parents cannot form a cycle.
    area_of_cover = np.where(covered, area_px[None, :], np.inf)
    parents = np.where(covered.any(axis=1), area_of_cover.argmin(axis=1), NONE)
    return parents.astype(np.int32)


def depths(parent: Int32[np.ndarray, " M"]) -> UInt8[np.ndarray, " M"]:
    """Depth of every mask in its tree: roots 1, their children 2, and so on."""
    depth = np.ones(len(parent), dtype=np.uint8)
    ancestor = parent.copy()
    while (ancestor != NONE).any():
        climbing = ancestor != NONE
        depth[climbing] += 1
        ancestor[climbing] = parent[ancestor[climbing]]
    return depth


def coverage_tree(
    masks: HierarchicalMasks, settings: CoverageTreeSettings
) -> tuple[Int32[np.ndarray, " M"], UInt8[np.ndarray, " M"]]:
    """Parent (row or `NONE`) and depth (roots 1) of every mask of a view, always a forest."""
    level = masks.level if settings.parents == "coarser" else None
    parent = parents_from_overlaps(masks.overlaps_px(), settings.theta, level)
    return parent, depths(parent)
