"""Nodes: masks linked across views, the Gaussians and parent of each node, and the masks that show it."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float32, Float64, Int32, Int64, UInt8

from hilsplat.base.levels import LEVELS, NONE
from hilsplat.base.memory import MIB, limit_mib, require_memory
from hilsplat.contributions.compositing import column_sums
from hilsplat.semantic_tree.kernels import add_views, divide_by_unions
from hilsplat.semantic_tree.linkage import Evidence, mask_evidence, pooled_linkage
from hilsplat.semantic_tree.view_pairs import ViewPairs, view_pairs
from hilsplat.settings import SemanticTreeSettings

MIN_VISIBLE_PX = 0.3  # a Gaussian counts as visible in a view if its mass there exceeds this
SAMPLED_VIEWS = 8  # number of views whose pairs of masks are counted to estimate the memory of all pairs

PAIR_BYTES, LINKED_PAIR_BYTES = 80, 40
"""Memory per pair of masks while a level is compared, and while it is linked."""

BASE_MIB, ENTRY_BYTES, GAUSSIAN_BYTES = 300, 40, 300
"""Other memory of the stage: of libraries, per entry of a level's rows of S, and per Gaussian."""

MIN_COVISIBLE = 0.2
"""Two masks are not used as evidence if each mask's view shows less than this share of the other mask."""

MIN_MEMBER_SHARE = 0.05
"""A Gaussian joins its best node if that node contains more than this share of its weight."""

MIN_FIT = 0.25  # a mask is assigned to its best-fitting node if their IoU in the mask's view exceeds this

PRIOR_VIEWS = 3
"""Number of average views added to the views that show a node, to limit the influence of a single view."""

NEIGHBOURS = 11
"""Number of nearest Gaussians (including itself) to which each Gaussian of a node is connected."""

STRAY_SHARE = 0.02
"""A piece is removed from its node if its mass is less than this share of the largest piece's mass."""


@dataclass(frozen=True)
class LevelNodes:
    """Nodes of one level, numbered from 0.

    Attributes:
        of_mask: node that each mask of the level belongs to, -1 for none.
        of_gaussian: node of each Gaussian, -1 for none.
        membership: share of each Gaussian's visible weight that is inside its node's masks.
        quality: pooled IoU of each node.
    """

    of_mask: Int64[np.ndarray, " m"]
    of_gaussian: Int32[np.ndarray, " N"]
    membership: Float32[np.ndarray, " N"]
    quality: Float64[np.ndarray, " t"]

    def joined(self, into: Int64[np.ndarray, " t"]) -> "LevelNodes":
        """Merge nodes with the same number in `into`; the new quality is the mean over their masks."""
        into_or_none = np.append(into, NONE)
        masks = np.bincount(self.of_mask[self.of_mask != NONE], minlength=len(into))
        total = np.bincount(into, masks * self.quality)
        return LevelNodes(
            into_or_none[self.of_mask],
            into_or_none[self.of_gaussian].astype(np.int32),
            self.membership,
            total / np.maximum(np.bincount(into, masks), 1),
        )


def linked_nodes(
    S: sp.csr_matrix,
    mass: sp.csr_matrix,  # V x N
    view_of_mask: Int32[np.ndarray, " M"],
    rows_of_levels: Sequence[Int64[np.ndarray, " _"]],
    settings: SemanticTreeSettings,
    threads: int,
    memory_mib: float | None = None,
) -> Iterator[LevelNodes]:
    """Link the masks of each level (rows of `S`) into nodes, and assign Gaussians to them.

    A cluster whose Gaussians all belong to other clusters, such as a duplicate, would select no Gaussians. A
    cluster therefore becomes a node only if it is the best fit of at least `min_views` masks.

    Linking takes one thread; with several, the next level is prepared at the same time. `S` and `mass`,
    the visible mass of each Gaussian in each view, are in px; masks are sorted by view.

    Raises:
        MemoryLimitError: the pairs of masks need more than `memory_mib`, or more than this machine has.
    """
    visible = visible_in(mass)
    total_mass = column_sums(mass)
    importance = column_sums(visible) / np.maximum(num_views_of(visible), 1)
    pairs = view_pairs(visible)

    def evidence(rows: Int64[np.ndarray, " m"], pairs: ViewPairs = pairs) -> Evidence:
        view, shares = view_of_mask[rows], S[rows].astype(np.float64)
        there = mass_at_entries(shares, mass, view)
        shares.data /= np.where(there > MIN_VISIBLE_PX, there, np.inf)
        shares.eliminate_zeros()
        return mask_evidence(shares, importance, visible, view, pairs, MIN_COVISIBLE, threads)

    def nodes(
        rows: Int64[np.ndarray, " m"], cluster: Int64[np.ndarray, " m"], quality: Float64[np.ndarray, " k"]
    ) -> LevelNodes:
        weights, view = S[rows], view_of_mask[rows]
        pairs = np.unique(np.stack([cluster, view.astype(np.int64)], axis=1), axis=0)
        with_views = np.flatnonzero(np.bincount(pairs[:, 0], minlength=len(quality)) >= settings.min_views)

        def winners(with_views: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            of_cluster = np.full(len(quality) + 1, NONE, np.int64)
            of_cluster[with_views] = np.arange(len(with_views))
            return of_cluster, *gaussian_nodes(
                of_cluster[cluster], len(with_views), weights, view, mass, total_mass
            )

        of_cluster, node, share = winners(with_views)
        fits, iou = best_fits(level_ious(node, weights, mass, view))
        is_best = np.bincount(fits[iou > MIN_FIT], minlength=len(with_views)) >= settings.min_views
        if not is_best.all():
            with_views = with_views[is_best]
            of_cluster, node, share = winners(with_views)
        renumber = renumbered_without_empty(node, len(with_views))
        of_mask = renumber[of_cluster[cluster]].astype(np.int64)
        return LevelNodes(of_mask, renumber[node], share, quality[with_views[renumber[:-1] != NONE]])

    def most_at_once() -> int:
        """Return 2 if memory suffices to compare a level while another is linked, else 1.

        If the pairs of all masks of partner views don't fit, those of a few views are counted.
        """
        num_views, most_mib = mass.shape[0], limit_mib(memory_mib)
        entries = max(int(np.diff(S.indptr)[rows].sum()) for rows in rows_of_levels)
        other_mib = BASE_MIB + (ENTRY_BYTES * entries + GAUSSIAN_BYTES * S.shape[1]) / MIB
        first = np.repeat(np.arange(num_views), np.diff(pairs.indptr))
        masks = [np.bincount(view_of_mask[rows], minlength=num_views) for rows in rows_of_levels]
        counts = [float(number[first] @ number[pairs.partners]) / 2 for number in masks]
        if other_mib + _pairs_mib(counts, 2) > most_mib:
            sampled = pairs.of_views(np.linspace(0, num_views - 1, SAMPLED_VIEWS).astype(np.int64))
            scale = (len(pairs.partners) - num_views) / max(1, len(sampled.partners) - num_views)
            counts = [scale * evidence(rows, sampled).num_pairs for rows in rows_of_levels]
        require_memory(
            other_mib + _pairs_mib(counts, 1),
            memory_mib,
            f"the semantic tree of {len(view_of_mask):,} masks in {num_views:,} views",
            "use fewer photographs, or divide the scene into blocks (docs/large_captures.md)",
        )
        return 2 if other_mib + _pairs_mib(counts, 2) <= most_mib else 1

    meanwhile = most_at_once() > 1 and threads > 1
    with ThreadPoolExecutor(1, "linkage") as linker:
        linked: list[Future[Any]] = []
        for rows in rows_of_levels:
            wait(() if meanwhile else linked)
            of_level = evidence(rows)
            wait(linked)
            linked.append(linker.submit(pooled_linkage(of_level, settings.link_threshold)))
            del of_level
        wait(linked if threads == 1 else ())
        for rows, clusters in zip(rows_of_levels, linked, strict=True):
            yield nodes(rows, *clusters.result())


def _pairs_mib(counts: Sequence[float], at_once: int) -> float:
    """Return the memory for the pairs of masks of each level, of one or two levels at once, MiB."""
    linked = counts[:-1] if at_once > 1 else [0.0] * (len(counts) - 1)
    pairs = zip(counts, [0.0, *linked], strict=True)
    return max(PAIR_BYTES * compared + LINKED_PAIR_BYTES * before for compared, before in pairs) / MIB


def _row_of(matrix: sp.csr_matrix) -> Int64[np.ndarray, " E"]:
    """Return the row of each stored value."""
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))


def visible_in(mass: sp.csr_matrix) -> sp.csr_matrix:
    """Return the entries of Gaussians that are visible in a view."""
    visible = mass.data > MIN_VISIBLE_PX
    indptr = np.concatenate([[0], np.cumsum(visible)])[mass.indptr]
    return sp.csr_matrix((mass.data[visible], mass.indices[visible], indptr), shape=mass.shape)


def num_views_of(visible: sp.csr_matrix) -> Int64[np.ndarray, " N"]:
    """Return the number of views in which each Gaussian is visible."""
    return np.bincount(visible.indices, minlength=visible.shape[1])


def mass_at_entries(
    matrix: sp.csr_matrix, mass: sp.csr_matrix, view: Int32[np.ndarray, " m"] | Int64[np.ndarray, " m"]
) -> Float32[np.ndarray, " E"]:
    """Return the mass of each stored entry's Gaussian in the view of its row, px."""
    out = np.zeros(matrix.nnz, np.float32)
    rows, order = np.arange(len(view)), np.argsort(view, kind="stable")
    add_views(_mass_arrays(mass), view, rows, order, (matrix.indptr, matrix.indices), out)
    return out


def _mass_arrays(mass: sp.csr_matrix) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    return mass.indptr, mass.indices, mass.data, mass.shape[1]


def gaussian_nodes(
    cluster: Int64[np.ndarray, " M"],
    num_nodes: int,
    weights: sp.csr_matrix,
    view: Int32[np.ndarray, " M"],
    mass: sp.csr_matrix,  # V x N
    total_mass: Float64[np.ndarray, " N"],
) -> tuple[Int32[np.ndarray, " N"], Float32[np.ndarray, " N"]]:
    """Assign each Gaussian to the node with the largest product of two shares of its visible weight.

    The first is the share inside the node's masks in all views; it must exceed `MIN_MEMBER_SHARE`. The second
    is the same share in the views with a mask of the node, with `PRIOR_VIEWS` average views added to its
    denominator. The second share lets a small object that is segmented in few views keep its Gaussians next
    to a large object whose masks sometimes cover them. Masks of one view may overlap, and a node may have
    several masks in one view, so a Gaussian's weight in a view is capped at its visible mass there.

    `cluster` is the node of each mask, -1 for none; `weights` and `view` describe the same masks. `mass` is
    as in `linked_nodes`; `total_mass` is the sum of `mass` over views.

    Returns:
        node of each Gaussian, -1 for none (on a tie, the lowest node), and its share in all views.
    """
    inside = np.flatnonzero(cluster >= 0)
    ones = np.ones(len(inside))
    num_views = mass.shape[0]
    node_views, of_pair = np.unique(cluster[inside] * num_views + view[inside], return_inverse=True)
    pair_node, pair_view = np.divmod(node_views, max(num_views, 1))
    in_pair = sp.csr_matrix((ones, (of_pair, inside)), shape=(len(node_views), len(cluster)))
    per_view = in_pair @ weights.astype(np.float64)
    capped = np.minimum(per_view.data, mass_at_entries(per_view, mass, pair_view))
    shape = (num_nodes, weights.shape[1])
    entries = pair_node[_row_of(per_view)], per_view.indices
    per_node = sp.csr_matrix((capped, entries), shape=shape)
    del per_view, capped, entries
    per_node.data /= np.maximum(total_mass[per_node.indices], 1e-12)
    per_node.data[per_node.data <= MIN_MEMBER_SHARE] = 0
    per_node.eliminate_zeros()
    column, share = per_node.indices, per_node.data
    in_its_views = np.zeros(per_node.nnz)
    by_view = np.argsort(pair_view, kind="stable")
    matrix = per_node.indptr, column
    add_views(_mass_arrays(mass), pair_view, pair_node, by_view, matrix, in_its_views)
    one_view = total_mass / np.maximum(num_views_of(visible_in(mass)), 1)
    share_there = share * total_mass[column] / (in_its_views + PRIOR_VIEWS * one_view[column])
    product, largest = share * share_there, np.zeros(shape[1])
    np.maximum.at(largest, column, product)
    # The last of several assignments counts, so entries are in descending order of their nodes.
    best = np.flatnonzero(product == largest[column])[::-1]
    node_of_gaussian = np.full(shape[1], NONE, np.int32)
    membership = np.zeros(shape[1], np.float32)
    node_of_gaussian[column[best]] = _row_of(per_node)[best]
    membership[column[best]] = share[best]
    return node_of_gaussian, membership


def nearest_gaussians(means: Float[np.ndarray, "N 3"], threads: int) -> Int64[np.ndarray, "N K"]:
    """Return the `NEIGHBOURS` nearest Gaussians of each Gaussian, itself included."""
    from scipy.spatial import cKDTree  # lazy: takes 0.2 s, and queries import this module

    near = np.arange(1, min(NEIGHBOURS, len(means)) + 1)
    return cKDTree(means).query(means, k=near, workers=threads)[1]


def without_strays(
    node_of_gaussian: Int32[np.ndarray, " N"],  # -1 for none
    nearest: Int64[np.ndarray, "N K"],
    total_mass: Float64[np.ndarray, " N"],  # visible weight over all views, px
) -> Int32[np.ndarray, " N"]:
    """Remove stray pieces from nodes: Gaussians inside an object's masks, but behind or beside the object.

    Two Gaussians of a node are connected if one is among the other's nearest (`nearest_gaussians`).
    """
    num = len(node_of_gaussian)
    row, neighbour = np.repeat(np.arange(num), nearest.shape[1]), nearest.ravel()
    joined = (node_of_gaussian[row] == node_of_gaussian[neighbour]) & (node_of_gaussian[row] != NONE)
    graph = sp.csr_matrix((np.ones(joined.sum()), (row[joined], neighbour[joined])), shape=(num, num))
    _, piece = sp.csgraph.connected_components(graph, directed=False)
    piece_mass = np.bincount(piece, total_mass)
    largest = np.zeros(int(node_of_gaussian.max(initial=NONE)) + 2)
    np.maximum.at(largest, node_of_gaussian, piece_mass[piece])
    stray = piece_mass[piece] < STRAY_SHARE * largest[node_of_gaussian]
    return np.where(stray, NONE, node_of_gaussian).astype(np.int32)


def node_parents(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    level: UInt8[np.ndarray, " T"],
    mass: Float[np.ndarray, " N"],
    min_coverage: float,
) -> Int32[np.ndarray, " T"]:
    """Return each node's parent: the coarser node with more than `min_coverage` of its visible mass.

    The next coarser level is searched first, then the one above it, so that a whole may be the direct
    parent of a subpart. Nodes without such a parent are orphans (-1).
    """
    num = len(level)
    parent = np.full(num, NONE, np.int32)
    for child_level in LEVELS[1:]:
        child = node_of_gaussian[:, child_level.index]
        size = np.bincount(child[child >= 0], mass[child >= 0], minlength=num)
        for coarser in reversed(LEVELS[: child_level.index]):
            coarse = node_of_gaussian[:, coarser.index]
            in_both = (child >= 0) & (coarse >= 0)
            shared = sp.csr_matrix((mass[in_both], (child[in_both], coarse[in_both])), shape=(num, num))
            best, weight = best_fits(shared)
            adopted = (level == int(child_level)) & (parent == NONE) & (weight > min_coverage * size)
            parent[adopted] = best[adopted]
    return parent


def mask_fits(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    S: sp.csr_matrix,
    mass: sp.csr_matrix,  # V x N
    view: Int32[np.ndarray, " M"],
    level: UInt8[np.ndarray, " M"],
    linked: Int32[np.ndarray, " M"],
) -> tuple[Int32[np.ndarray, " M"], Float64[np.ndarray, " M"]]:
    """Return the node that each mask shows: the one with the best soft IoU in the mask's view.

    `linked` is the node that each mask was linked into, -1 for none; `S` and `mass` are in px, as in
    `Contributions`.

    Returns:
        best node at the mask's level, -1 if the mask shares no Gaussians with any node; and the IoU with the
        linked node, 0 if there is none.
    """
    fits, of_linked = np.full(len(view), NONE, np.int32), np.zeros(len(view))
    for of_level in LEVELS:
        rows = np.flatnonzero(level == int(of_level))
        iou = level_ious(node_of_gaussian[:, of_level.index], S[rows], mass, view[rows])
        fits[rows], _ = best_fits(iou)
        inside = linked[rows] != NONE
        of_linked[rows[inside]] = np.asarray(iou[np.flatnonzero(inside), linked[rows[inside]]]).ravel()
    return fits, of_linked


def level_ious(
    node_of_gaussian: Int32[np.ndarray, " N"],
    weights: sp.csr_matrix,
    mass: sp.csr_matrix,  # V x N
    view: Int32[np.ndarray, " m"],
) -> sp.csr_matrix:
    """Return each mask's soft IoU, in the mask's view, with each node that shares Gaussians with the mask.

    `weights` is S of the level's masks; `mass` is the visible mass of each Gaussian in each view, px.
    """
    has = np.flatnonzero(node_of_gaussian >= 0)
    node = node_of_gaussian[has]
    num_nodes = int(node.max(initial=NONE)) + 1
    member = sp.csr_matrix((np.ones(len(has)), (has, node)), shape=(len(node_of_gaussian), num_nodes))
    inter = (weights.astype(np.float64) @ member).tocsr()
    area = np.asarray(weights.sum(axis=1, dtype=np.float64)).ravel()
    order = np.argsort(view, kind="stable")
    matrix = inter.indptr, inter.indices
    divide_by_unions(_mass_arrays(mass), view, order, node_of_gaussian, area, matrix, inter.data)
    return inter


def best_fits(iou: sp.csr_matrix) -> tuple[Int32[np.ndarray, " m"], Float64[np.ndarray, " m"]]:
    """Return the column (lowest on a tie) and value of each row's maximum; -1 and 0 for empty rows."""
    best, value = np.full(iou.shape[0], NONE, np.int32), np.zeros(iou.shape[0])
    counts = np.diff(iou.indptr)
    filled = np.flatnonzero(counts)
    if len(filled):
        starts = iou.indptr[filled]
        value[filled] = np.maximum.reduceat(iou.data, starts)
        is_largest = iou.data == np.repeat(value, counts)
        best[filled] = np.minimum.reduceat(np.where(is_largest, iou.indices, iou.shape[1]), starts)
    return best, value


def nest_nodes(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    level: UInt8[np.ndarray, " T"],
    parent: Int32[np.ndarray, " T"],
) -> Int32[np.ndarray, "N 3"]:
    """Make every child a subset of its parent, so that the tree is nested by construction.

    A Gaussian of a child is added to the parent and the parent's parent if no other node of their levels
    contains it; otherwise, it is removed from the child. Coarse levels are processed first.
    """
    nested = node_of_gaussian.copy()
    index_of = level.astype(np.int64) - 1
    for child_level in LEVELS[1:]:
        child = nested[:, child_level.index]
        members = np.flatnonzero(child >= 0)
        members = members[parent[child[members]] != NONE]
        above = parent[child[members]]
        ancestors = np.stack([above, np.where(parent[above] != NONE, parent[above], above)])
        held = nested[members, index_of[ancestors]]
        fits = ((held == ancestors) | (held == NONE)).all(axis=0)
        nested[members[fits], index_of[ancestors[:, fits]]] = ancestors[:, fits]
        nested[members[~fits], child_level.index] = NONE
    return nested


def renumbered_without_empty(
    node_of_gaussian: Int32[np.ndarray, "..."], num_nodes: int
) -> Int32[np.ndarray, " T1"]:
    """Return each node's new id, in the old order; NONE for nodes without Gaussians.

    Nesting may remove a node's last Gaussian; its children are then empty too, so no parent is lost. The
    result has an additional last entry, NONE, so that indexing with NONE returns NONE.
    """
    used = np.unique(node_of_gaussian[node_of_gaussian >= 0])
    renumber = np.full(num_nodes + 1, NONE, np.int32)
    renumber[used] = np.arange(len(used))
    return renumber


def node_means(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    level: UInt8[np.ndarray, " T"],
    features: Float32[np.ndarray, "N 3 D"],
) -> Float32[np.ndarray, "T D"]:
    """Return the mean feature of each node's Gaussians at its level, ignoring features that are all zeros."""
    sums = np.zeros((len(level), features.shape[2]))
    for of_level in LEVELS:
        node = node_of_gaussian[:, of_level.index]
        has_feature = (node >= 0) & (features[:, of_level.index] != 0).any(axis=1)
        counts = np.bincount(node[has_feature], minlength=len(level))
        for channel in range(features.shape[2]):
            total = np.bincount(node[has_feature], features[has_feature, of_level.index, channel], len(level))
            sums[:, channel] += total / np.maximum(counts, 1)
    return sums.astype(np.float32)
