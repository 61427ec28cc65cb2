"""The 3D semantic tree of a scene: nodes, their Gaussians, parents, boxes, vectors, and pixels in views."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float32, Int32, Int64, UInt8

from hilsplat.base.arrays import build_checked
from hilsplat.base.artifacts import damaged, read_index, read_npz, rebuild_command, sealed
from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.embed.vectors import mask_embeddings
from hilsplat.semantic_tree.kernels import blend_nodes, mask_of_nodes, summed_by_node

LIMITS = {"level": (1, 3), "quality": (0, 1), "membership": (0, 1 + 1e-5), "views": (0, 2**31 - 1)}
"""Valid range of each array in a stored tree."""

BOX_PERCENTILES = (2.0, 98.0)
"""Percentiles of a node's Gaussian centres that bound its box, so that stray Gaussians do not inflate it."""

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class OrientedBox:
    """A box with its own axes.

    Attributes:
        centre: scene units.
        axes: three orthogonal unit vectors, right-handed; the first is along the longest side.
        size: full length along each axis, scene units.
    """

    centre: Triple
    axes: tuple[Triple, Triple, Triple]
    size: Triple

    @staticmethod
    def from_array(rows: Float[np.ndarray, "5 3"]) -> "OrientedBox":
        """Create a box from its stored form: centre, three axes, sizes."""
        centre, first, second, third, size = ((x, y, z) for x, y, z in np.asarray(rows, np.float64).tolist())
        return OrientedBox(centre, (first, second, third), size)

    def corners(self) -> Float[np.ndarray, "8 3"]:
        signs = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
        return np.asarray(self.centre) + (signs * np.asarray(self.size)) @ np.asarray(self.axes)


@dataclass(frozen=True)
class SemanticTree:
    """T nodes at three levels, coarse to fine.

    Attributes:
        parent: row of the coarser node that contains each node, -1 for none.
        clip: unit CLIP vector of each node; empty (C = 0) in the tree that the stage writes.
        centroid: mean of the Gaussians' centres, weighted by visible mass, scene units.
        box: axis-aligned box, lower and upper corner, scene units.
        oriented_box: centre, three axes and sizes (see `OrientedBox`), scene units.
        quality: pooled IoU of each node's masks across views, in [0, 1].
        views: number of views with masks of each node.
        node_of_gaussian: node of each Gaussian at each level, -1 for none.
        membership: share of each Gaussian's visible weight that is inside its node's masks, in [0, 1]; 0
            without a node, and for a Gaussian added only because a child of the node contains it.
        node_of_mask: node that each mask (row of the contributions) fits best at its level; -1 if it shares
            no Gaussians with any node.
        linked_node: node that each mask was linked into, -1 for none.
        crop_score: how well each mask's crop shows the node that the mask was linked into: the mask's IoU
            with the node in the mask's view, times the square root of the mask's area, px; 0 without a node.
        crop_rank: order in which the crops of a node are embedded (`build.crop_ranks`), -1 for none.
        view_area_px: area of each node's masks in each view.
        gaussians_sha256: digest of the PLY from which the tree was computed.
        cameras_sha256: digest of the scene's cameras.
        min_weight: weights below this are dropped in the contributions and when views are rendered.
    """

    level: UInt8[np.ndarray, " T"]
    parent: Int32[np.ndarray, " T"]
    clip: Float32[np.ndarray, "T C"]
    centroid: Float32[np.ndarray, "T 3"]
    box: Float32[np.ndarray, "T 2 3"]
    oriented_box: Float32[np.ndarray, "T 5 3"]
    quality: Float32[np.ndarray, " T"]
    views: Int32[np.ndarray, " T"]
    node_of_gaussian: Int32[np.ndarray, "N 3"]
    membership: Float32[np.ndarray, "N 3"]
    node_of_mask: Int32[np.ndarray, " M"]
    linked_node: Int32[np.ndarray, " M"]
    crop_score: Float32[np.ndarray, " M"]
    crop_rank: Int32[np.ndarray, " M"]
    view_area_px: Float32[np.ndarray, "T V"]
    view_names: tuple[str, ...]
    gaussians_sha256: str
    cameras_sha256: str
    min_weight: float

    def __len__(self) -> int:
        return len(self.level)

    def _require_whole(self, path: Path) -> None:
        """Raise ArtifactError if an array refers to a missing node or a parent isn't coarser than a child."""
        last = len(self) - 1
        rows = {"parent": self.parent, "node_of_gaussian": self.node_of_gaussian}
        rows |= {"node_of_mask": self.node_of_mask, "linked_node": self.linked_node}
        for name, values in rows.items():
            if values.size and (values.min() < NONE or values.max() > last):
                problem, found = "refers to nodes that do not exist", f"{values.min()} to {values.max()}"
                raise damaged(path, f": array {name} {problem}", expected=f"-1 to {last}", found=found)
        child = self.parent != NONE
        if (self.level[self.parent[child]] >= self.level[child]).any():
            raise damaged(path, ": a node's parent is not at a coarser level")

    def nodes_of(self, level: Level) -> Int64[np.ndarray, " t"]:
        return np.flatnonzero(self.level == int(level))

    def children_of(self, nodes: Int64[np.ndarray, " t"]) -> Int64[np.ndarray, " c"]:
        return np.flatnonzero(np.isin(self.parent, nodes))

    def ancestors(self) -> Int32[np.ndarray, "T 3"]:
        """Return the node that contains each node at each level: itself at its own level, -1 for none."""
        containing = np.full((len(self), len(LEVELS)), NONE, np.int32)
        rows, above = np.arange(len(self)), np.arange(len(self), dtype=np.int32)
        while len(rows):
            containing[rows, self.level[above] - 1] = above
            above = self.parent[above]
            rows, above = rows[above != NONE], above[above != NONE]
        return containing

    def with_vectors(self, vectors: Float32[np.ndarray, "M C"]) -> "SemanticTree":
        """Return the tree with node vectors: the normalised sum of mask vectors, weighted by `crop_score`.

        The vector of a mask whose crop was not embedded is zero.
        """
        sums = np.zeros((len(self), vectors.shape[1]))
        linked = np.flatnonzero(self.linked_node != NONE)
        np.add.at(sums, self.linked_node[linked], self.crop_score[linked, None] * vectors[linked])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
        return replace(self, clip=sums.astype(np.float32))

    @staticmethod
    def load(folder: Path, clip_folder: Path | None = None) -> "SemanticTree":
        """Read a finished semantic tree; node vectors are computed from the CLIP vectors in `clip_folder`.

        Raises:
            ArtifactError: the tree is missing, damaged or from a different version of hilsplat.
            MisalignedArtifactError: the vectors belong to different masks, or to a different tree of them.
        """
        folder, names = Path(folder), ("gaussians_sha256", "cameras_sha256", "min_weight")
        index = read_index(folder, *names)
        values = {"view_names": tuple(index["views"]), **{name: index[name] for name in names}}
        path = sealed(folder, "tree.npz")
        tree = build_checked(SemanticTree, read_npz(path), values, path, LIMITS)
        tree._require_whole(path)
        if clip_folder is None:
            return tree
        tree = tree.with_vectors(mask_embeddings(clip_folder, folder))
        if not tree.clip.any(axis=1).all():
            raise MisalignedArtifactError(
                f"{clip_folder} has no vector for some nodes of {folder}",
                expected="vectors of the masks that show each node",
                found=f"none for {int((~tree.clip.any(axis=1)).sum())} of {len(tree)} nodes",
                fix=rebuild_command(Path(clip_folder)),
            )
        return tree


def oriented_box(
    points: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]
) -> Float32[np.ndarray, "5 3"]:
    """Return the box along the weighted points' principal axes, from their 2nd to their 98th percentile.

    The array contains centre, axes and sizes (`OrientedBox.from_array`). The largest component of the first
    two axes is positive.
    """
    mean = (weight[:, None] * points).sum(axis=0) / weight.sum()
    centred = points - mean
    covariance = np.einsum("n,ni,nj->ij", weight, centred, centred)
    _, vectors = np.linalg.eigh(covariance)
    axes = vectors.T
    low, high = np.percentile(centred @ axes.T, BOX_PERCENTILES, axis=0)
    order = np.argsort(low - high, kind="stable")
    axes, low, high = axes[order], low[order], high[order]
    sign = np.sign(axes[np.arange(3), np.abs(axes).argmax(axis=1)])
    sign[2] = sign[2] * np.sign(np.linalg.det(axes * sign[:, None]))
    axes = axes * sign[:, None]
    low, high = np.where(sign > 0, low, -high), np.where(sign > 0, high, -low)
    centre = mean + ((low + high) / 2) @ axes
    return np.concatenate([centre[None], axes, (high - low)[None]]).astype(np.float32)


def node_boxes(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    level: UInt8[np.ndarray, " T"],
    means: Float[np.ndarray, "N 3"],
    mass: Float[np.ndarray, " N"],
) -> tuple[Float32[np.ndarray, "T 3"], Float32[np.ndarray, "T 2 3"], Float32[np.ndarray, "T 5 3"]]:
    """Return each node's centroid, axis-aligned box and oriented box.

    Centroids and axes are weighted by visible mass. No node may be empty (`nodes.renumbered_without_empty`).
    """
    centroid = np.zeros((len(level), 3), np.float32)
    box = np.zeros((len(level), 2, 3), np.float32)
    oriented = np.zeros((len(level), 5, 3), np.float32)
    order = np.argsort(node_of_gaussian, axis=0, kind="stable")
    ids = np.arange(len(level) + 1)
    starts = [np.searchsorted(node_of_gaussian[rows, k], ids) for k, rows in enumerate(order.T)]
    for node, node_level in enumerate(level):
        index = Level(int(node_level)).index
        members = order[starts[index][node] : starts[index][node + 1], index]
        weight = mass[members] / mass[members].sum()
        points = means[members]
        centroid[node] = (weight[:, None] * points).sum(axis=0)
        box[node] = np.percentile(points, BOX_PERCENTILES, axis=0)
        oriented[node] = oriented_box(points.astype(np.float64), weight)
    return centroid, box, oriented


@dataclass(frozen=True)
class ViewNodes:
    """Share of each node of one level in each pixel of a view (CSR over P pixels).

    A pixel blends about ten Gaussians, but rarely more than two nodes of a level. Summing the weights by node
    once per view makes each later query in that view several times faster than a product with all weights,
    and needs only a fraction of the memory.

    Attributes:
        nodes: rows of the semantic tree.
        shares: each node's share of the pixel; the remainder belongs to no node.
        covered: whether the Gaussians cover each pixel.
    """

    indptr: Int64[np.ndarray, " P1"]
    nodes: Int32[np.ndarray, " E"]
    shares: Float32[np.ndarray, " E"]
    covered: Bool[np.ndarray, " P"]

    @staticmethod
    def of(weights: sp.csr_matrix, node_of_gaussian: Int32[np.ndarray, " N"]) -> "ViewNodes":
        """Sum normalised weights (rows sum to 1 or are empty) by node."""
        indptr, nodes, shares = summed_by_node(
            weights.indptr, weights.indices, weights.data, np.ascontiguousarray(node_of_gaussian)
        )
        return ViewNodes(indptr, nodes, shares, np.diff(weights.indptr) > 0)

    def area_px(self, num_nodes: int) -> Int64[np.ndarray, " n"]:
        """Return the number of pixels in which each node has a share above 0.5."""
        return np.bincount(self.nodes[self.shares > 0.5], minlength=num_nodes)

    def blend(
        self, values: Float32[np.ndarray, " n"], without: float, out: Float32[np.ndarray, " P"] | None = None
    ) -> Float32[np.ndarray, " P"]:
        """Blend one value per node; Gaussians without a node have the value `without`.

        Uncovered pixels get the lowest value of the covered pixels. The result is written to `out` if given.
        """
        out = np.empty(len(self.covered), np.float32) if out is None else out
        blend_nodes(self.indptr, self.nodes, self.shares, self.covered, values, np.float32(without), out)
        return out

    def mask(self, chosen: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " P"]:
        """Return the pixels in which the chosen nodes have a total share above 0.5."""
        out = np.zeros(len(self.covered), np.bool_)
        mask_of_nodes(self.indptr, self.nodes, self.shares, chosen, out)
        return out

    def labels(self, size_hw: tuple[int, int]) -> Int32[np.ndarray, "H W"]:
        """Return the node with a share above 0.5 in each pixel, -1 for none."""
        out = np.full(len(self.covered), NONE, np.int32)
        dominant = np.flatnonzero(self.shares > 0.5)
        out[np.searchsorted(self.indptr, dominant, side="right") - 1] = self.nodes[dominant]
        return out.reshape(size_hw)
