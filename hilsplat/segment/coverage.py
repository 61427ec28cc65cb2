"""Coverage tree of a view: the parent of each mask (paper, Sec. III-B), and the stage `coverage_tree`."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32, Int64, UInt8

from hilsplat.base.artifacts import read_index, write_index, write_npz
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.progress import stage_log, track
from hilsplat.segment.digests import MASKS_SHA256, digests_in, load_masks
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import CoverageTreeSettings, MasksSettings


def coverage_parents(
    overlap_px: Int64[np.ndarray, "M M"], level: UInt8[np.ndarray, " M"] | None, theta: float
) -> Int32[np.ndarray, " M"]:
    """Return the parent of every mask of one view (paper, Sec. III-B).

    Mask `a` is a child of mask `b` if more than `theta` of `a` is inside `b` and less than `theta` of `b` is
    inside `a`. The parent is the smallest such `b`, or on a tie the one with the lower row.

    Departs: the paper doesn't specify which levels a parent may come from. Here a parent's level is
    coarser than its child's; the parent of a subpart may be a whole.

    Args:
        overlap_px: number of pixels shared by each pair of masks; the diagonal contains the masks' areas,
            which are positive.
        level: `Level` of each mask; None allows parents from any level, as printed in the paper.
        theta: coverage threshold, a share in (0, 1); the paper uses 0.9.

    Returns:
        Row of each mask's parent, or `NONE` if no mask covers it.

    Example:
        >>> overlap_px = np.array([[4, 2], [2, 2]])  # the second mask is inside the first
        >>> coverage_parents(overlap_px, np.array([1, 2], np.uint8), theta=0.9)
        array([-1,  0], dtype=int32)
    """
    area_px = np.diagonal(overlap_px)
    if not len(area_px):
        return np.zeros(0, dtype=np.int32)
    share = overlap_px / area_px[:, None]  # [a, b]: share of a inside b
    covered = (share > theta) & (share < theta).T
    if level is not None:
        covered &= level[None, :] < level[:, None]
    # covered[a, b] implies area[a] < area[b], so chains of parents cannot form a cycle.
    area_of_cover = np.where(covered, area_px[None, :], np.inf)
    parents = np.where(covered.any(axis=1), area_of_cover.argmin(axis=1), NONE)
    return parents.astype(np.int32)


def depths(parent: Int32[np.ndarray, " M"]) -> UInt8[np.ndarray, " M"]:
    """Return the depth of every mask in its tree: 1 for roots, 2 for their children, and so on."""
    depth = np.ones(len(parent), dtype=np.uint8)
    ancestor = parent.copy()
    while (ancestor != NONE).any():
        climbing = ancestor != NONE
        depth[climbing] += 1
        ancestor[climbing] = parent[ancestor[climbing]]
    return depth


def coverage_tree(
    masks: HierarchicalMasks, theta: float
) -> tuple[Int32[np.ndarray, " M"], UInt8[np.ndarray, " M"]]:
    """Return the parent (row or `NONE`) and the depth (1 for roots) of every mask of a view."""
    parent = coverage_parents(masks.overlaps_px(), masks.level, theta)
    return parent, depths(parent)


def levelled(masks: HierarchicalMasks, settings: MasksSettings) -> HierarchicalMasks:
    """Return the masks, in the same order, with the levels that the settings select; by default, their own.

    With `levels: tree`, they are the depths in the view's tree: roots become wholes, their children parts,
    and all other descendants subparts, regardless of the head that predicted them. This rule is from a
    comment in the source of the paper (Sec. III-B).
    """
    if settings.levels == "head":
        return masks
    theta = settings.theta or CoverageTreeSettings().theta
    depth = depths(coverage_parents(masks.overlaps_px(), None, theta))
    return replace(masks, level=np.minimum(depth, len(LEVELS)).astype(np.uint8))


def run_coverage_tree(masks_folder: Path, out: Path, settings: CoverageTreeSettings) -> None:
    """For every view, write `<view>.npz` with `parent` i32 (M) and `depth` u8 (M); also write `index.json`.

    Rows are in the order of the masks. A MisalignedArtifactError is raised if a view's masks differ from
    those recorded in their index.
    """
    scene, digests = read_index(masks_folder)["scene"], digests_in(masks_folder)
    index: dict[str, Any] = {}
    with stage_log("coverage_tree", scene) as counts, atomic_folder(out) as folder:
        for view in track(list(digests), "coverage trees"):
            masks = load_masks(masks_folder, view, digests)
            parent, depth = coverage_tree(masks, settings.theta)
            write_npz(folder / f"{view}.npz", parent=parent, depth=depth)
            has_parent = parent != NONE
            index[view] = {
                MASKS_SHA256: digests[view],
                "masks": len(masks),
                "roots": int((~has_parent).sum()),
                "part_with_parent": int(has_parent[masks.rows_of(Level.PART)].sum()),
                "subpart_with_parent": int(has_parent[masks.rows_of(Level.SUBPART)].sum()),
                "deepest": int(depth.max(initial=0)),
            }
        write_index(folder, index, scene=scene)
        counts.update(
            views=len(index),
            masks=sum(entry["masks"] for entry in index.values()),
            roots=sum(entry["roots"] for entry in index.values()),
        )
