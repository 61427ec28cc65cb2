"""Joining of the finished blocks of a scene (`scene.blocks`) into one scene that accepts queries.

A Gaussian is kept from the block that its centre belongs to, and the masks and CLIP vectors of a view from
the block that owns the view. Nodes of two blocks become one if their masks agree in the views that both have.
"""

import itertools
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float64, Int64

from hilsplat.base.artifacts import read_index, sealed, write_index
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import LEVELS, NONE
from hilsplat.base.lineage import read_provenance, require_made_from, sha256_of_file
from hilsplat.base.progress import stage_log, track
from hilsplat.contributions.compositing import column_sums
from hilsplat.contributions.rows import Contributions
from hilsplat.embed.vectors import mask_embeddings
from hilsplat.scene.blocks import Blocks
from hilsplat.scene.finished import FinishedScene, SceneParts, input_of
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import digests_in, load_masks, require_same_masks
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.semantic_tree.build import described_tree, nested_nodes, write_tree
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import SemanticTreeSettings
from hilsplat.splat.coordinates import move_gaussians, write_coordinates
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.ply import load_ply, save_ply

SAME = 0.5  # pooled IoU of two nodes' masks in shared views above which the nodes become one

MIN_KEPT = 0.5
"""Minimum share of a node's visible weight that is kept, summed over the blocks that have the node.
Otherwise, a thing beyond the border that the other block segments differently would become two nodes."""


def inputs_of(folder: Path) -> list[Path]:
    """Return what is read of a block, a finished scene; raise ArtifactError if it is not finished."""
    parts = FinishedScene.locate(folder).parts
    contributions = _contributions_of(parts)
    artifacts = (parts.scene, parts.gaussians, parts.masks, parts.clip, parts.semantic_tree)
    return [*artifacts, contributions / "rows.npz", contributions / "mass"]


def _contributions_of(parts: SceneParts) -> Path:
    return input_of(parts.semantic_tree, "contributions", parts.scene.parent)


@dataclass(frozen=True, eq=False)
class FinishedBlock:
    """A finished block, in the coordinates of the whole scene, with nodes numbered across all blocks.

    Attributes:
        tree: all nodes and masks of the block, but only the kept Gaussians.
        gaussians: the kept Gaussians, whose centres belong to the block.
        mass: visible weight of each kept Gaussian over the block's views, px.
        kept_share: share of each node's visible weight that is kept.
        digests: digest of each view's masks.
        rows: rows of each view's masks in the tree.
        area_px: area of each mask.
        has_vector: whether each mask's crop was embedded.
    """

    parts: SceneParts
    tree: SemanticTree
    gaussians: Gaussians
    mass: Float64[np.ndarray, " n"]
    kept_share: Float64[np.ndarray, " t"]
    digests: dict[str, str]
    rows: dict[str, Int64[np.ndarray, " m"]]
    area_px: Int64[np.ndarray, " M"]
    has_vector: Bool[np.ndarray, " M"]

    @staticmethod
    def open(folder: Path, number: int, blocks: Blocks, first: int) -> "FinishedBlock":
        """Read the results of block `number`, whose nodes are numbered from `first`."""
        parts = FinishedScene.locate(folder).parts
        tree = SemanticTree.load(parts.semantic_tree)
        contributions = Contributions.load(_contributions_of(parts))
        digest = sha256_of_file(parts.gaussians)
        require_made_from(parts.semantic_tree, parts.gaussians, tree.gaussians_sha256, digest)
        require_made_from(contributions.folder, parts.gaussians, contributions.gaussians_sha256, digest)
        require_same_masks(parts.semantic_tree, parts.masks)
        views = require_same_masks(parts.masks, contributions.folder)
        whole_from_block = np.linalg.inv(Scene.load(parts.scene).scene_from_source)
        gaussians = move_gaussians(load_ply(parts.gaussians), whole_from_block)
        owned = np.flatnonzero(blocks.owner_of(gaussians.means) == number)
        mass = column_sums(contributions.matrix("mass"))
        node, mass_of_node = tree.node_of_gaussian, np.repeat(mass[:, None], len(LEVELS), axis=1)
        total, own_mass = (
            np.bincount(node[rows][node[rows] != NONE], mass_of_node[rows][node[rows] != NONE], len(tree))
            for rows in (slice(None), owned)
        )

        def numbered(nodes: np.ndarray) -> Any:
            return np.where(nodes == NONE, NONE, nodes + first).astype(np.int32)

        return FinishedBlock(
            parts,
            replace(
                tree,
                node_of_gaussian=numbered(node[owned]),
                membership=tree.membership[owned],
                node_of_mask=numbered(tree.node_of_mask),
                linked_node=numbered(tree.linked_node),
            ),
            Gaussians(*(getattr(gaussians, name)[owned] for name in FIELDS)),
            mass[owned],
            own_mass / np.maximum(total, 1e-12),
            digests_in(parts.masks),
            dict(zip(views, contributions.rows_of_views(), strict=True)),
            contributions.area_px,
            np.asarray(mask_embeddings(parts.clip, parts.semantic_tree).any(axis=1)),
        )

    def linked_masks(self, view: str) -> tuple[np.ndarray, HierarchicalMasks]:
        """Return the masks of a view that have a node, and their nodes."""
        nodes = self.tree.linked_node[self.rows[view]]
        linked = np.flatnonzero(nodes != NONE)
        return nodes[linked], load_masks(self.parts.masks, view, self.digests).take(linked)


def same_nodes(
    overlap_px: sp.csr_matrix,  # T x T
    area_px: sp.csr_matrix,  # T x V
) -> Int64[np.ndarray, " T"]:
    """Number the things that nodes show; nodes with the same number become one.

    These are nodes whose masks overlap in more than `SAME` of their union. Both are summed over the views in
    which both nodes have masks.

    Args:
        overlap_px: pixels that masks of two nodes share, over all shared views.
        area_px: pixels of each node's masks in each shared view.
    """
    pairs, is_shown = overlap_px.tocoo(), (area_px > 0).astype(np.float64)
    first, second = pairs.row, pairs.col
    sums = area_px[first].multiply(is_shown[second]) + is_shown[first].multiply(area_px[second])
    union = np.asarray(sums.sum(axis=1)).ravel() - pairs.data
    same = pairs.data > SAME * union
    graph = sp.csr_matrix((np.ones(same.sum()), (first[same], second[same])), shape=overlap_px.shape)
    return sp.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def matched_nodes(blocks: Sequence[FinishedBlock]) -> Int64[np.ndarray, " T"]:
    """Compare the nodes of blocks in the views that several blocks have, and number things (`same_nodes`)."""
    counts = Counter(view for block in blocks for view in block.digests)
    views = sorted(view for view, count in counts.items() if count > 1)
    none = np.zeros(0, np.int64)
    overlaps, areas = [(none, none, none)], [(none, none, none)]
    for column, view in enumerate(track(views, "shared views")):
        of_blocks = [block.linked_masks(view) for block in blocks if view in block.digests]
        areas += [(nodes, np.full(len(nodes), column), masks.area_px) for nodes, masks in of_blocks]
        for (nodes, masks), (others, of_others) in itertools.combinations(of_blocks, 2):
            px = HierarchicalMasks.concatenate([masks, of_others]).overlaps_px()[: len(masks), len(masks) :]
            row, col = np.nonzero(np.where(masks.level[:, None] == of_others.level, px, 0))
            overlaps.append((nodes[row], others[col], px[row, col]))

    def matrix(entries: Sequence[tuple[np.ndarray, ...]], columns: int) -> sp.csr_matrix:
        row, col, px = map(np.concatenate, zip(*entries, strict=True))
        return sp.csr_matrix((px.astype(np.float64), (row, col)), shape=(num_nodes, columns))

    num_nodes = sum(len(block.tree) for block in blocks)
    return same_nodes(matrix(overlaps, num_nodes), matrix(areas, len(views)))


def joined_tree(
    blocks: Sequence[FinishedBlock], owner: Mapping[str, int], scene: Scene, gaussians_sha256: str
) -> SemanticTree:
    """Return the tree of the joined scene, whose Gaussians are those of its blocks, in order.

    A node is left out if it has no embedded crop, and so no vector, or is mostly elsewhere (`MIN_KEPT`).

    Args:
        owner: number of the block that owns each view with masks.
    """
    of_view = [(blocks[number], blocks[number].rows[view]) for view, number in owner.items()]
    linked, fits, crop_score = (
        np.concatenate([getattr(block.tree, name)[rows] for block, rows in of_view])
        for name in ("linked_node", "node_of_mask", "crop_score")
    )
    area_px = np.concatenate([block.area_px[rows] for block, rows in of_view])
    has_vector = np.concatenate([block.has_vector[rows] for block, rows in of_view])
    level_of_node, quality_of_node, num_views, node_of_gaussian, membership = (
        np.concatenate([getattr(block.tree, name) for block in blocks])
        for name in ("level", "quality", "views", "node_of_gaussian", "membership")
    )
    mass = np.concatenate([block.mass for block in blocks])
    kept_share = np.concatenate([block.kept_share for block in blocks])

    thing = matched_nodes(blocks)  # one number for all nodes that become one
    level = np.zeros(thing.max(initial=NONE) + 1, np.uint8)
    level[thing] = level_of_node
    weight = np.maximum(num_views, 1)
    quality = np.bincount(thing, weight * quality_of_node) / np.bincount(thing, weight)
    crops = np.bincount(thing[linked[has_vector & (linked != NONE)]], minlength=len(level))
    chosen = np.flatnonzero((crops > 0) & (np.bincount(thing, kept_share) >= MIN_KEPT))
    chosen = chosen[np.argsort(level[chosen], kind="stable")]  # coarse nodes first, as in any tree
    id_of_thing = np.full(len(level), NONE, np.int32)
    id_of_thing[chosen] = np.arange(len(chosen))
    node = np.append(id_of_thing[thing], np.int32(NONE))

    record = read_provenance(blocks[0].parts.semantic_tree)
    settings = SemanticTreeSettings(**(record.settings["semantic_tree"] if record else {}))
    node_of_gaussian, membership, levels, parent, renumber = nested_nodes(
        node[node_of_gaussian], membership, level[chosen], mass, settings.parent_coverage
    )
    linked_node = renumber[node[linked]]
    return described_tree(
        node_of_gaussian=node_of_gaussian,
        membership=np.where(node_of_gaussian == NONE, np.float32(0), membership),
        level=levels,
        parent=parent,
        quality=quality[chosen][renumber[:-1] != NONE].astype(np.float32),
        node_of_mask=renumber[node[fits]],
        linked_node=linked_node,
        crop_score=np.where(linked_node == NONE, np.float32(0), crop_score),
        means=np.concatenate([block.gaussians.means for block in blocks]),
        mass=mass,
        view=np.repeat(np.arange(len(of_view), dtype=np.int32), [len(rows) for _, rows in of_view]),
        area_px=area_px,
        centres=np.stack([scene.cameras[view].centre for view in owner]),
        view_names=tuple(owner),
        gaussians_sha256=gaussians_sha256,
        cameras_sha256=sha256_of_file(scene.folder / "cameras.npz"),
        min_weight=blocks[0].tree.min_weight,
    )


def run_joined(blocks_folder: Path, scene_folder: Path, finished: Sequence[Path], out: Path) -> None:
    """Write the semantic tree of the joined scene to `out`, and the other parts that queries need.

    `masks` and `clip` are written beside it, and `scene` (a copy) and `gaussians.ply` in the folder above.

    Args:
        blocks_folder: folder with `blocks.json`.
        scene_folder: the posed scene that was split.
        finished: results of each block, in the order of `blocks.json`.

    Raises:
        ArtifactError: a block is not finished.
        MisalignedArtifactError: the scene's poses have changed, or the blocks have different settings.
    """
    described, scene = Blocks.load(blocks_folder), Scene.load(scene_folder)
    digest = sha256_of_file(scene_folder / "cameras.npz")
    require_made_from(blocks_folder, scene_folder, described.cameras_sha256, digest, "split the scene again")
    with stage_log("join", scene.name) as counts:
        blocks: list[FinishedBlock] = []
        for number, folder in enumerate(finished):
            first = sum(len(block.tree) for block in blocks)
            blocks.append(FinishedBlock.open(folder, number, described, first))
        _require_same_settings(blocks)
        owned = {view: n for n, block in enumerate(described.blocks.values()) for view in block.owned}
        owner = {view: owned[view] for view in scene.views("train") if view in blocks[owned[view]].digests}
        with atomic_folder(out.parent.parent / "scene") as folder:
            shutil.copytree(scene_folder, folder, dirs_exist_ok=True)
        _copy_views([block.parts.masks for block in blocks], ".npz", owner, scene, out.with_name("masks"))
        entries = _copy_views(
            [block.parts.clip for block in blocks], ".npy", owner, scene, out.with_name("clip")
        )
        fields = (np.concatenate([getattr(block.gaussians, name) for block in blocks]) for name in FIELDS)
        gaussians, ply = Gaussians(*fields), out.parent.parent / "gaussians.ply"
        save_ply(ply, gaussians)
        write_coordinates(ply, scene, gaussians, {"kind": "joined", "blocks": list(described.blocks)})
        tree = joined_tree(blocks, owner, scene, sha256_of_file(ply))
        write_tree(out, tree, scene.name, entries)
        counts |= {"blocks": len(blocks), "views": len(owner), "gaussians": len(gaussians)}
        counts |= {"nodes": len(tree), "nodes_of_blocks": sum(len(block.tree) for block in blocks)}


def _require_same_settings(blocks: Sequence[FinishedBlock]) -> None:
    """Raise MisalignedArtifactError if the results of the blocks cannot be mixed."""
    settings = {}
    for block in blocks:
        masks, clip = read_index(block.parts.masks), read_index(block.parts.clip)
        models = {"segmenter": masks["segmenter"], "SAM": masks["model_sha256"], "CLIP": clip["model_sha256"]}
        properties = {"min_weight": block.tree.min_weight, "degree": block.gaussians.sh_degree}
        settings[block.parts.scene.parent.name] = {**models, **properties}
    if any(values != next(iter(settings.values())) for values in settings.values()):
        raise MisalignedArtifactError(
            "the blocks were run with different models or settings",
            expected="the same models and settings in all blocks",
            found="; ".join(f"{name}: {values}" for name, values in settings.items()),
            fix="run the blocks again with the same configuration",
        )


def _copy_views(
    sources: Sequence[Path], suffix: str, owner: Mapping[str, int], scene: Scene, out: Path
) -> dict[str, Any]:
    """Copy each view's file of an artifact from the block that owns it; return the views' index entries."""
    indices = [read_index(source) for source in sources]
    entries = {view: indices[number]["views"][view] for view, number in owner.items()}
    with atomic_folder(out) as folder:
        for view, number in owner.items():
            shutil.copyfile(sealed(sources[number], f"{view}{suffix}"), folder / f"{view}{suffix}")
        same = {name: value for name, value in indices[0].items() if name not in ("views", "crc32", "scene")}
        write_index(folder, entries, scene=scene.name, **same)
    return entries
