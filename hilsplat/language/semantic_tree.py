"""The 3D semantic tree: masks of all views linked by the Gaussians they share.

No mask has an identity across views. Two masks of different views and the same level are linked by
how far they agree on the Gaussians that both views see; clusters of masks become nodes, nodes take
their Gaussians, a coarser node that holds most of a finer one becomes its parent, and every node
gets the average of its masks' full CLIP vectors. Queries are answered by ranking nodes.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float32, Int32, Int64, UInt8

from hilsplat.base.artifacts import (
    INDEX,
    atomic_folder,
    read_index,
    read_npz,
    sha256_of_file,
    write_index,
    write_json,
    write_npz,
)
from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.progress import stage_log
from hilsplat.language.linkage import mask_evidence, pooled_linkage
from hilsplat.language.mask_rows import Contributions, mask_embeddings
from hilsplat.settings import SemanticTreeSettings

logger = logging.getLogger(__name__)

BOX_PERCENTILES = (2.0, 98.0)
"""Of the members' centres: a few stray Gaussians do not blow up a node's box."""


@dataclass(frozen=True)
class SemanticTree:
    """T nodes at three levels, coarse to fine.

    Attributes:
        level: `Level` of each node.
        parent: row of the coarser node that holds it, -1 for none.
        clip: unit CLIP vector, the average of its masks' vectors weighted by the root of their area.
        centroid: mean of its Gaussians' centres weighted by visible mass, scene units.
        box: axis-aligned box, lower and upper corner, scene units.
        quality: pooled IoU of its masks across views, in [0, 1].
        views: number of views with a mask of it.
        node_of_gaussian: node of each Gaussian at each level, -1 for none.
        node_of_mask: node that each mask (row of the contributions) fits, -1 for none.
        view_area_px: pixels of its masks in each view.
        view_names: the columns of `view_area_px`.
        gaussians_sha256: digest of the PLY the tree belongs to.
    """

    level: UInt8[np.ndarray, " T"]
    parent: Int32[np.ndarray, " T"]
    clip: Float32[np.ndarray, "T C"]
    centroid: Float32[np.ndarray, "T 3"]
    box: Float32[np.ndarray, "T 2 3"]
    quality: Float32[np.ndarray, " T"]
    views: Int32[np.ndarray, " T"]
    node_of_gaussian: Int32[np.ndarray, "N 3"]
    node_of_mask: Int32[np.ndarray, " M"]
    view_area_px: Float32[np.ndarray, "T V"]
    view_names: tuple[str, ...]
    gaussians_sha256: str

    def __len__(self) -> int:
        return len(self.level)

    def nodes_of(self, level: Level) -> Int64[np.ndarray, " t"]:
        """Nodes of a level, in order."""
        return np.flatnonzero(self.level == int(level))

    def children_of(self, nodes: Int64[np.ndarray, " t"]) -> Int64[np.ndarray, " c"]:
        """Direct children of any of the nodes."""
        return np.flatnonzero(np.isin(self.parent, nodes))

    def descendants_of(self, nodes: Int64[np.ndarray, " t"]) -> Int64[np.ndarray, " c"]:
        """Children, and children of children."""
        found = self.children_of(nodes)
        while True:
            more = np.union1d(found, self.children_of(found))
            if len(more) == len(found):
                return found
            found = more

    @staticmethod
    def load(folder: Path) -> "SemanticTree":
        """Read a finished semantic tree."""
        folder = Path(folder)
        index = read_index(folder)
        return SemanticTree(
            **read_npz(folder / "tree.npz"),
            view_names=tuple(index["views"]),
            gaussians_sha256=index["gaussians_sha256"],
        )


def gaussian_nodes(
    cluster: Int64[np.ndarray, " M"], num_nodes: int, shares: sp.csr_matrix, min_share: float
) -> Int32[np.ndarray, " N"]:
    """Give each Gaussian the node in which the largest share of its visible weight lies.

    Args:
        cluster: node of each mask of one level, -1 for none.
        num_nodes: number of nodes.
        shares: weight of each Gaussian in each mask over its weight in all views.
        min_share: Gaussians whose best node holds no more than this stay without a node.

    Returns:
        node of each Gaussian, -1 for none; of equal shares the lowest node.
    """
    inside = np.flatnonzero(cluster >= 0)
    member = sp.csr_matrix((np.ones(len(inside)), (cluster[inside], inside)), shape=(num_nodes, len(cluster)))
    per_node = (member @ shares.astype(np.float64)).tocoo()
    node = np.full(shares.shape[1], NONE, np.int32)
    order = np.lexsort((per_node.row, -per_node.data, per_node.col))
    column = per_node.col[order]
    first = np.flatnonzero(np.concatenate(([True], column[1:] != column[:-1]))[: len(column)])
    chosen = order[first]
    chosen = chosen[per_node.data[chosen] > min_share]
    node[per_node.col[chosen]] = per_node.row[chosen]
    return node


def node_parents(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    level: UInt8[np.ndarray, " T"],
    mass: Float[np.ndarray, " N"],
    min_coverage: float,
) -> Int32[np.ndarray, " T"]:
    """Parent of each node: the coarser node that holds more than `min_coverage` of its visible mass.

    The next coarser level is searched first, then the one above it, so that a subpart may hang
    directly under a whole. Nodes without such a cover are orphans (-1).
    """
    num = len(level)
    parent = np.full(num, NONE, np.int32)
    for child_level in LEVELS[1:]:
        own = node_of_gaussian[:, child_level.index]
        size = np.bincount(own[own >= 0], mass[own >= 0], minlength=num)
        for coarser in reversed(LEVELS[: child_level.index]):
            other = node_of_gaussian[:, coarser.index]
            both = (own >= 0) & (other >= 0)
            shared = sp.csr_matrix((mass[both], (own[both], other[both])), shape=(num, num))
            shared.sum_duplicates()
            for node in np.flatnonzero((level == int(child_level)) & (parent == NONE)):
                row = slice(shared.indptr[node], shared.indptr[node + 1])
                if row.start == row.stop:
                    continue
                best = row.start + int(shared.data[row].argmax())
                if shared.data[best] > min_coverage * size[node]:
                    parent[node] = shared.indices[best]
    return parent


def mask_fits(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    num_nodes: int,
    S: sp.csr_matrix,
    mass: Float32[np.ndarray, "V N"],
    view: Int32[np.ndarray, " M"],
    level: UInt8[np.ndarray, " M"],
    min_fit: float,
) -> Int32[np.ndarray, " M"]:
    """Node that each mask shows: the best soft IoU, in the mask's view, of mask and node's Gaussians.

    Returns:
        node of the mask's level above `min_fit`, else -1.
    """
    fits = np.full(len(view), NONE, np.int32)
    area = np.asarray(S.sum(axis=1, dtype=np.float64)).ravel()
    for each in LEVELS:
        node = node_of_gaussian[:, each.index]
        has = np.flatnonzero(node >= 0)
        member = sp.csr_matrix((np.ones(len(has)), (has, node[has])), shape=(len(node), num_nodes))
        rows = np.flatnonzero(level == int(each))
        inter = (S[rows].astype(np.float64) @ member).tocsr()
        size = np.asarray(member.T @ mass.T.astype(np.float64))  # [node, view]
        for place, row in enumerate(rows):
            span = slice(inter.indptr[place], inter.indptr[place + 1])
            if span.start == span.stop:
                continue
            nodes, shared = inter.indices[span], inter.data[span]
            iou = shared / (area[row] + size[nodes, view[row]] - shared)
            best = np.lexsort((nodes, -iou))[0]
            if iou[best] > min_fit:
                fits[row] = nodes[best]
    return fits


def build_tree(
    contributions: Contributions,
    S: sp.csr_matrix,
    mass: Float32[np.ndarray, "V N"],
    clip: Float32[np.ndarray, "M C"],
    means: Float[np.ndarray, "N 3"],
    settings: SemanticTreeSettings,
) -> SemanticTree:
    """Link masks, make nodes, and give them Gaussians, parents, vectors and boxes.

    Args:
        contributions: rows of the masks.
        S: weight of each Gaussian in each raw mask.
        mass: weight of each Gaussian in each view.
        clip: CLIP vector of each mask.
        means: centres of the Gaussians.
        settings: thresholds.
    """
    visible = mass > settings.min_visible_px
    num_visible = visible.sum(axis=0)
    total_mass = mass.sum(axis=0, dtype=np.float64)
    importance = np.where(num_visible > 0, (mass * visible).sum(axis=0, dtype=np.float64), 0.0)
    importance /= np.maximum(num_visible, 1)
    shares_in_view = _divide(S, np.where(visible, mass, np.inf)[contributions.view[_row_of(S)], S.indices])
    shares_in_all = _divide(S, np.maximum(total_mass, 1e-12)[S.indices])

    level: list[int] = []
    quality: list[float] = []
    cluster_of_mask = np.full(len(contributions), NONE, np.int64)
    node_of_gaussian = np.full((S.shape[1], len(LEVELS)), NONE, np.int32)
    for each in LEVELS:
        rows = contributions.rows_of(each)
        view = contributions.view[rows]
        evidence = mask_evidence(
            shares_in_view[rows], importance, visible, view, settings.min_covisible, settings.overlap
        )
        cluster, cluster_quality = pooled_linkage(evidence, settings.link_threshold)
        seen = [len(np.unique(view[cluster == c])) for c in range(int(cluster.max(initial=-1)) + 1)]
        large = np.flatnonzero(np.array(seen, dtype=np.int64) >= settings.min_views)
        local = np.full(len(seen) + 1, NONE, np.int64)
        local[large] = np.arange(len(large))
        nodes = gaussian_nodes(local[cluster], len(large), shares_in_all[rows], settings.min_member_share)
        # A node that wins no Gaussian selects nothing: it is dropped.
        used = np.unique(nodes[nodes >= 0])
        renumber = np.full(len(large) + 1, NONE, np.int64)
        renumber[used] = len(level) + np.arange(len(used))
        node_of_gaussian[:, each.index] = renumber[nodes]
        cluster_of_mask[rows] = renumber[local[cluster]]
        level += [int(each)] * len(used)
        quality += cluster_quality[large[used]].tolist()

    levels = np.array(level, np.uint8)
    num = len(levels)
    view_area = np.zeros((num, len(contributions.views)), np.float64)
    own = np.flatnonzero(cluster_of_mask >= 0)
    np.add.at(view_area, (cluster_of_mask[own], contributions.view[own]), contributions.area_px[own])
    vectors = np.zeros((num, clip.shape[1]), np.float64)
    root_area = np.sqrt(contributions.area_px[own].astype(np.float64))
    np.add.at(vectors, cluster_of_mask[own], root_area[:, None] * clip[own])
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    centroid, box = _node_boxes(node_of_gaussian, levels, means, total_mass)
    return SemanticTree(
        level=levels,
        parent=node_parents(node_of_gaussian, levels, total_mass, settings.parent_coverage),
        clip=vectors.astype(np.float32),
        centroid=centroid,
        box=box,
        quality=np.array(quality, np.float32),
        views=(view_area > 0).sum(axis=1).astype(np.int32),
        node_of_gaussian=node_of_gaussian,
        node_of_mask=mask_fits(
            node_of_gaussian, num, S, mass, contributions.view, contributions.level, settings.min_fit
        ),
        view_area_px=view_area.astype(np.float32),
        view_names=contributions.views,
        gaussians_sha256=contributions.gaussians_sha256,
    )


def run_semantic_tree(
    contributions_folder: Path,
    masks_folder: Path,
    clip_folder: Path,
    out: Path,
    settings: SemanticTreeSettings,
) -> None:
    """Write the 3D semantic tree of a scene: `tree.npz`, the readable `tree.json`, `index.json`.

    Raises:
        MisalignedArtifactError: contributions or CLIP vectors were made from other masks.
    """
    contributions = Contributions.load(contributions_folder)
    index = read_index(contributions_folder)
    scene = index["scene"]
    masks_sha256 = sha256_of_file(Path(masks_folder) / INDEX)
    if masks_sha256 != index["masks_sha256"]:
        raise MisalignedArtifactError(
            f"contributions of {scene} belong to other masks",
            expected=f"{masks_folder} with index sha256 {index['masks_sha256'][:12]}",
            found=f"sha256 {masks_sha256[:12]}",
            fix="run the contributions stage again",
        )
    with stage_log("semantic tree", scene) as counts:
        tree = build_tree(
            contributions,
            contributions.matrix("S"),
            contributions.mass(),
            mask_embeddings(clip_folder, contributions),
            contributions.means(),
            settings,
        )
        per_level = {level.label: len(tree.nodes_of(level)) for level in LEVELS}
        orphans = {
            level.label: int((tree.parent[tree.nodes_of(level)] == NONE).sum()) for level in LEVELS[1:]
        }
        counts |= {**per_level, "orphans": sum(orphans.values())}
        if not len(tree):
            logger.warning(
                "semantic tree %s has no node: no mask was found again in %d views; "
                "lower semantic_tree.min_views or semantic_tree.link_threshold",
                scene,
                settings.min_views,
            )
        masks = np.bincount(contributions.view, minlength=len(contributions.views))
        with atomic_folder(out) as folder:
            fields = {name: value for name, value in vars(tree).items() if isinstance(value, np.ndarray)}
            write_npz(folder / "tree.npz", **fields)
            write_json(folder / "tree.json", {"scene": scene, "nodes": readable_nodes(tree)})
            write_index(
                folder,
                {view: {"masks": int(count)} for view, count in zip(contributions.views, masks, strict=True)},
                scene=scene,
                nodes=per_level,
                orphans=orphans,
                masks_with_node=int((tree.node_of_mask >= 0).sum()),
                masks=len(contributions),
                gaussians_sha256=contributions.gaussians_sha256,
            )


def readable_nodes(tree: SemanticTree) -> list[dict]:
    """One entry per node, for people."""
    members = [np.bincount(column[column >= 0], minlength=len(tree)) for column in tree.node_of_gaussian.T]
    return [
        {
            "node": node,
            "level": Level(int(tree.level[node])).label,
            "parent": int(tree.parent[node]),
            "children": tree.children_of(np.array([node])).tolist(),
            "gaussians": int(members[Level(int(tree.level[node])).index][node]),
            "views": int(tree.views[node]),
            "best_view": tree.view_names[int(tree.view_area_px[node].argmax())],
            "quality": round(float(tree.quality[node]), 4),
            "centroid": [round(float(value), 4) for value in tree.centroid[node]],
            "box": [[round(float(value), 4) for value in corner] for corner in tree.box[node]],
        }
        for node in range(len(tree))
    ]


def _row_of(matrix: sp.csr_matrix) -> np.ndarray:
    """Row of every stored value."""
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))


def _divide(matrix: sp.csr_matrix, by: np.ndarray) -> sp.csr_matrix:
    """Divide the stored values one by one (float64); those divided by infinity are dropped."""
    divided = sp.csr_matrix(
        (matrix.data.astype(np.float64) / by, matrix.indices.copy(), matrix.indptr.copy()), shape=matrix.shape
    )
    divided.eliminate_zeros()
    return divided


def _node_boxes(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    level: UInt8[np.ndarray, " T"],
    means: Float[np.ndarray, "N 3"],
    mass: Float[np.ndarray, " N"],
) -> tuple[Float32[np.ndarray, "T 3"], Float32[np.ndarray, "T 2 3"]]:
    """Centroid and box of every node's members."""
    centroid = np.zeros((len(level), 3), np.float32)
    box = np.zeros((len(level), 2, 3), np.float32)
    for node, each in enumerate(level):
        members = np.flatnonzero(node_of_gaussian[:, Level(int(each)).index] == node)
        weight = mass[members] / mass[members].sum()
        centroid[node] = (weight[:, None] * means[members]).sum(axis=0)
        box[node] = np.percentile(means[members], BOX_PERCENTILES, axis=0)
    return centroid, box
