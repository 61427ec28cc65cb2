"""The nodes of one level: masks linked across views, and the Gaussians assigned to them."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from hilsplat.base.levels import NONE
from hilsplat.semantic_tree.evidence import mask_evidence
from hilsplat.semantic_tree.linkage import pooled_linkage
from hilsplat.semantic_tree.nodes import best_fits, gaussian_nodes, level_ious
from hilsplat.settings import SemanticTreeSettings

MIN_COVISIBLE = 0.2
"""Pairs of masks whose views see less than this share of each other are no evidence."""

MIN_MEMBER_SHARE = 0.05
"""A Gaussian joins its best node if that node holds more than this share of its weight."""

MIN_FIT = 0.25
"""A mask shows its best-fitting node if their IoU in the mask's view is above this."""


@dataclass(frozen=True)
class LevelNodes:
    """Nodes of one level, numbered from 0.

    Attributes:
        of_mask: node that each mask of the level belongs to, -1 for none.
        of_gaussian: node of each Gaussian, -1 for none.
        membership: share of the Gaussian's visible weight inside its node's masks.
        quality: pooled IoU of each node.
    """

    of_mask: Int64[np.ndarray, " m"]
    of_gaussian: Int32[np.ndarray, " N"]
    membership: Float32[np.ndarray, " N"]
    quality: Float64[np.ndarray, " t"]

    def joined(self, into: Int64[np.ndarray, " t"]) -> "LevelNodes":
        """Merge nodes with the same number in `into`; the quality is the mean over their masks."""
        into_or_none = np.append(into, NONE)
        masks = np.bincount(self.of_mask[self.of_mask != NONE], minlength=len(into))
        total = np.bincount(into, masks * self.quality)
        return LevelNodes(
            into_or_none[self.of_mask],
            into_or_none[self.of_gaussian].astype(np.int32),
            self.membership,
            total / np.maximum(np.bincount(into, masks), 1),
        )


def level_nodes(
    weights: sp.csr_matrix,
    view: Int32[np.ndarray, " m"],
    mass: Float32[np.ndarray, "V N"],
    visible: Bool[np.ndarray, "V N"],
    importance: Float64[np.ndarray, " N"],
    total_mass: Float64[np.ndarray, " N"],
    settings: SemanticTreeSettings,
    threads: int,
) -> LevelNodes:
    """Link the masks of one level into nodes and assign Gaussians to them.

    A cluster whose Gaussians go to other clusters, such as a duplicate, could select nothing. A cluster
    therefore becomes a node only if at least `min_views` masks fit it best.

    Args:
        weights: S of the masks.
        view: view of each mask.
        mass: visible mass of each Gaussian in each view, px.
        visible: which Gaussians each view sees.
        importance: mean visible mass, px.
        total_mass: visible mass of each Gaussian, summed over views, px.
        settings: thresholds.
        threads: number of threads for the evidence.
    """
    seen_in = view[_row_of(weights)]
    shares = _divide(
        weights, np.where(visible[seen_in, weights.indices], mass[seen_in, weights.indices], np.inf)
    )
    del seen_in
    evidence = mask_evidence(
        shares,
        importance,
        visible,
        view,
        MIN_COVISIBLE,
        threads,
    )
    del shares
    cluster, quality = pooled_linkage(evidence, settings.link_threshold)
    del evidence
    pairs = np.unique(np.stack([cluster, view.astype(np.int64)], axis=1), axis=0)
    kept = np.flatnonzero(np.bincount(pairs[:, 0], minlength=len(quality)) >= settings.min_views)

    def winners(kept: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        of_cluster = np.full(len(quality) + 1, NONE, np.int64)
        of_cluster[kept] = np.arange(len(kept))
        return of_cluster, *gaussian_nodes(
            of_cluster[cluster], len(kept), weights, view, mass, total_mass, MIN_MEMBER_SHARE
        )

    fits, iou = best_fits(level_ious(winners(kept)[1], weights, mass, view))
    kept = kept[np.bincount(fits[iou > MIN_FIT], minlength=len(kept)) >= settings.min_views]
    of_cluster, node, share = winners(kept)
    # A node without Gaussians selects nothing, so it is dropped.
    used = np.unique(node[node >= 0])
    renumber = np.full(len(kept) + 1, NONE, np.int64)
    renumber[used] = np.arange(len(used))
    return LevelNodes(
        renumber[of_cluster[cluster]], renumber[node].astype(np.int32), share, quality[kept[used]]
    )


def _row_of(matrix: sp.csr_matrix) -> np.ndarray:
    """Return the row of each stored value."""
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))


def _divide(matrix: sp.csr_matrix, by: np.ndarray) -> sp.csr_matrix:
    """Divide each stored value (float64), and drop values divided by infinity."""
    divided = sp.csr_matrix(
        (matrix.data.astype(np.float64) / by, matrix.indices.copy(), matrix.indptr.copy()), shape=matrix.shape
    )
    divided.eliminate_zeros()
    return divided
