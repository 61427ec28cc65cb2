"""The semantic tree stage: links masks of different views by the Gaussians that they share.

Masks of one level in different views are linked by how well they agree on the Gaussians that both views see.
Clusters of masks become nodes, each Gaussian is assigned to its best node, and small stray pieces are
removed. A coarser node that contains most of a finer one becomes its parent. None of this needs CLIP: the
tree only scores each node's crops. The clip stage embeds the best crops, whose average is the node's vector.
"""

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8

from hilsplat.base.arrays import require_types
from hilsplat.base.artifacts import read_index, write_index, write_json, write_npz
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.progress import stage_log
from hilsplat.contributions.compositing import column_sums
from hilsplat.contributions.rows import Contributions
from hilsplat.segment.digests import require_same_masks
from hilsplat.semantic_tree.export import readable_nodes
from hilsplat.semantic_tree.nodes import (
    LevelNodes,
    linked_nodes,
    mask_fits,
    nearest_gaussians,
    nest_nodes,
    node_parents,
    renumbered_without_empty,
    without_strays,
)
from hilsplat.semantic_tree.tree import LIMITS, SemanticTree, node_boxes
from hilsplat.semantic_tree.wholes import joined_regions
from hilsplat.settings import SemanticTreeSettings

APART_DEG = 30.0  # crops with directions at least this far apart do not lower each other's score
MIN_NEW = 0.1  # share of a crop's score that remains if a higher-ranked crop has the same direction
MAX_RANKED = 32  # number of crops ranked per node
MIN_IOU = 1e-3  # lower bound of the IoU in `crop_score`, so that each linked mask has a positive score

logger = logging.getLogger(__name__)


def crop_ranks(
    node: Int32[np.ndarray, " M"], score: Float32[np.ndarray, " M"], directions: Float[np.ndarray, "M 3"]
) -> Int32[np.ndarray, " M"]:
    """Rank the masks of each node by score, reduced for directions close to those of higher-ranked masks.

    At equal scores, crops from different sides describe an object better (docs/experiments.md).

    Args:
        node: node that each mask shows, -1 for none.
        score: how well each mask's crop shows the node.
        directions: unit vectors from nodes to cameras.

    Returns:
        rank of each mask within its node, 0 for the best; -1 for masks without a node or beyond `MAX_RANKED`.
    """
    rank = np.full(len(node), NONE, np.int32)
    order = np.argsort(node, kind="stable")
    starts = np.flatnonzero(np.diff(node[order], prepend=NONE))
    for rows in np.split(order, starts)[1:]:
        remaining = score[rows].astype(np.float64)
        new = np.ones(len(rows))
        for number in range(min(MAX_RANKED, len(rows))):
            best = int((remaining * new).argmax())
            rank[rows[best]] = number
            cosine = np.clip(directions[rows] @ directions[rows[best]], -1, 1)
            apart = np.rad2deg(np.arccos(cosine)) / APART_DEG
            new = np.minimum(new, np.clip(apart, MIN_NEW, 1))
            remaining[best] = -1
    return rank


def build_tree(
    contributions: Contributions,
    settings: SemanticTreeSettings,
    threads: int,
    join_wholes: bool,
    of_levels: Iterable[LevelNodes] | None,
    memory_mib: float | None,
) -> SemanticTree:
    """Link masks into nodes, compute the nodes' Gaussians, parents and boxes, and score their crops.

    Args:
        threads: number of threads; it does not affect the result.
        join_wholes: join regions that touch in 3D, for segmenters that detect only colour regions.
        of_levels: nodes of each level, to use instead of linked masks.
    """
    S, mass, means = contributions.matrix("S"), contributions.matrix("mass"), contributions.means()
    view = contributions.view
    total_mass = column_sums(mass)

    level_of_node: list[int] = []
    quality: list[float] = []
    cluster_of_mask = np.full(len(contributions), NONE, np.int64)
    node_of_gaussian = np.full((S.shape[1], len(LEVELS)), NONE, np.int32)
    membership = np.zeros((S.shape[1], len(LEVELS)), np.float32)
    nearest = None if of_levels else nearest_gaussians(means, threads)
    rows_of_levels = [contributions.rows_of(level) for level in LEVELS]
    of_levels = of_levels or linked_nodes(S, mass, view, rows_of_levels, settings, threads, memory_mib)
    for level, rows, nodes in zip(LEVELS, rows_of_levels, of_levels, strict=True):
        if join_wholes and level is Level.WHOLE:
            whole = joined_regions(nodes.of_gaussian, len(nodes.quality), means, mass, settings.whole_side)
            nodes = nodes.joined(whole)
        renumber = np.append(len(level_of_node) + np.arange(len(nodes.quality)), NONE)
        of_gaussian = nodes.of_gaussian
        if nearest is not None:
            of_gaussian = without_strays(of_gaussian, nearest, total_mass)
        node_of_gaussian[:, level.index] = renumber[of_gaussian]
        membership[:, level.index] = np.where(of_gaussian == NONE, 0, nodes.membership)
        cluster_of_mask[rows] = renumber[nodes.of_mask]
        level_of_node += [int(level)] * len(nodes.quality)
        quality += nodes.quality.tolist()

    levels = np.array(level_of_node, np.uint8)
    nodes_of, membership, levels, parent, renumber = nested_nodes(
        node_of_gaussian, membership, levels, total_mass, settings.parent_coverage
    )
    linked_node = renumber[cluster_of_mask]
    fits, iou = mask_fits(nodes_of, S, mass, view, contributions.level, linked_node)
    # Nesting may remove the Gaussians that a node's masks show; the node still needs a crop.
    fit = np.where(linked_node == NONE, 0.0, np.maximum(iou, MIN_IOU))
    if join_wholes:  # a piece's mask has a low IoU with the joined whole, but still shows the whole
        pieces = contributions.rows_of(Level.WHOLE)
        fits[pieces] = linked_node[pieces]
    return described_tree(
        node_of_gaussian=nodes_of,
        membership=membership,
        level=levels,
        parent=parent,
        quality=np.array(quality, np.float32)[renumber[:-1] != NONE],
        node_of_mask=fits,
        linked_node=linked_node,
        crop_score=(np.sqrt(contributions.area_px) * fit).astype(np.float32),
        means=means,
        mass=total_mass,
        view=view,
        area_px=contributions.area_px,
        centres=contributions.centres(),
        view_names=contributions.views,
        gaussians_sha256=contributions.gaussians_sha256,
        cameras_sha256=contributions.cameras_sha256,
        min_weight=contributions.min_weight,
    )


def nested_nodes(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    membership: Float32[np.ndarray, "N 3"],
    level: UInt8[np.ndarray, " T"],
    mass: Float[np.ndarray, " N"],
    min_coverage: float,
) -> tuple[
    Int32[np.ndarray, "N 3"],
    Float32[np.ndarray, "N 3"],
    UInt8[np.ndarray, " t"],
    Int32[np.ndarray, " t"],
    Int32[np.ndarray, " T1"],
]:
    """Find the parents of nodes, make each child a subset of its parent, and leave out empty nodes.

    Returns:
        node of each Gaussian, memberships, level and parent of each remaining node, and the new id of each
        node (`nodes.renumbered_without_empty`).
    """
    parent = node_parents(node_of_gaussian, level, mass, min_coverage)
    nested = nest_nodes(node_of_gaussian, level, parent)
    membership = np.where(nested == node_of_gaussian, membership, np.float32(0))
    renumber = renumbered_without_empty(nested, len(level))
    occupied = np.flatnonzero(renumber[:-1] != NONE)
    return renumber[nested], membership, level[occupied], renumber[parent[occupied]], renumber


def described_tree(
    *,
    means: Float[np.ndarray, "N 3"],
    mass: Float[np.ndarray, " N"],
    view: Int32[np.ndarray, " M"],
    area_px: Int64[np.ndarray, " M"],
    centres: Float[np.ndarray, "V 3"],
    **fields: Any,
) -> SemanticTree:
    """Return a tree with the boxes, crop ranks and view areas of its nodes.

    Args:
        mass: visible weight of each Gaussian over all views, px.
        view: row of each mask's view in `centres`, the camera centres, and in `view_names`.
        fields: the other fields of `SemanticTree`.
    """
    linked_node, num = fields["linked_node"], len(fields["level"])
    view_area = np.zeros((num, len(centres)), np.float64)
    linked = np.flatnonzero(linked_node != NONE)
    np.add.at(view_area, (linked_node[linked], view[linked]), area_px[linked])
    centroid, box, oriented = node_boxes(fields["node_of_gaussian"], fields["level"], means, mass)
    towards = centres[view] - centroid[linked_node] if num else np.zeros((len(view), 3))
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    return SemanticTree(
        **fields,
        clip=np.zeros((num, 0), np.float32),
        centroid=centroid,
        box=box,
        oriented_box=oriented,
        views=(view_area > 0).sum(axis=1).astype(np.int32),
        crop_rank=crop_ranks(linked_node, fields["crop_score"], towards),
        view_area_px=view_area.astype(np.float32),
    )


def run_semantic_tree(
    contributions_folder: Path,
    masks_folder: Path,
    out: Path,
    settings: SemanticTreeSettings,
    threads: int = 1,
    of_levels: Iterable[LevelNodes] | None = None,
    memory_mib: float | None = None,
) -> None:
    """Write the 3D semantic tree of a scene: `tree.npz`, the human-readable `tree.json`, and `index.json`.

    `of_levels` is as in `build_tree`.

    Raises:
        MisalignedArtifactError: the contributions were computed from different masks.
        ArtifactError: the masks do not record their segmenter.
        MemoryLimitError: linking needs more than `memory_mib`, or more than this machine has.
    """
    contributions = Contributions.load(contributions_folder)
    index = read_index(contributions_folder)
    scene = index["scene"]
    require_same_masks(contributions_folder, masks_folder)
    with stage_log("semantic tree", scene) as counts:
        join_wholes = read_index(masks_folder, "segmenter")["segmenter"] == "graph"
        tree = build_tree(contributions, settings, threads, join_wholes, of_levels, memory_mib)
        counts |= {level.label: len(tree.nodes_of(level)) for level in LEVELS}
        counts["orphans"] = int(((tree.parent == NONE) & (tree.level > 1)).sum())
        if not len(tree):
            logger.warning(
                "the semantic tree of %s has no nodes: no group of linked masks spans %d views; "
                "lower semantic_tree.min_views or semantic_tree.link_threshold",
                scene,
                settings.min_views,
            )
        write_tree(out, tree, scene, index["views"])


def write_tree(out: Path, tree: SemanticTree, scene: str, entries: Mapping[str, Any]) -> None:
    """Write a tree with one entry per view in its index, atomically."""
    per_level = {level.label: len(tree.nodes_of(level)) for level in LEVELS}
    orphans = {level.label: int((tree.parent[tree.nodes_of(level)] == NONE).sum()) for level in LEVELS[1:]}
    with atomic_folder(out) as folder:
        fields = {name: value for name, value in vars(tree).items() if isinstance(value, np.ndarray)}
        require_types(SemanticTree, fields, out / "tree.npz", LIMITS)
        write_npz(folder / "tree.npz", **fields)
        write_json(folder / "tree.json", {"scene": scene, "nodes": readable_nodes(tree)})
        write_index(
            folder,
            entries,
            scene=scene,
            nodes=per_level,
            orphans=orphans,
            masks_with_node=int((tree.linked_node >= 0).sum()),
            masks=len(tree.linked_node),
            gaussians_sha256=tree.gaussians_sha256,
            cameras_sha256=tree.cameras_sha256,
            min_weight=tree.min_weight,
        )
