"""The nodes of a scene in one small file, which a query of many scenes reads instead of trees and vectors."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from hilsplat.base.arrays import build_checked, read_tensors, require_types, write_tensors
from hilsplat.base.artifacts import readable
from hilsplat.semantic_tree.tree import LIMITS, SemanticTree

FILE = "nodes.safetensors"

OF_PARTS = ("node_of_gaussian", "membership", "node_of_mask", "linked_node", "crop_score", "crop_rank")
"""Arrays of a tree with a row for each Gaussian or mask."""


@dataclass(frozen=True)
class NodeIndex:
    """Nodes with their vectors, sizes and best views.

    Attributes:
        tree: the scene's tree and vectors, without rows of Gaussians, masks and views.
        gaussians: number of each node's Gaussians.
        best_view: row in `views` of the training view in which each node is largest.
    """

    tree: SemanticTree
    gaussians: Int32[np.ndarray, " T"]
    best_view: Int32[np.ndarray, " T"]
    views: tuple[str, ...]

    @staticmethod
    def of(tree: SemanticTree) -> "NodeIndex":
        """Return the index of a tree with vectors."""
        gaussians = np.bincount(tree.node_of_gaussian.ravel() + 1, minlength=len(tree) + 1)[1:]
        best_view = tree.view_area_px.argmax(axis=1)
        none = {name: getattr(tree, name)[:0] for name in OF_PARTS}
        bare = replace(tree, **none, view_area_px=tree.view_area_px[:, :0], view_names=())
        return NodeIndex(bare, gaussians.astype(np.int32), best_view.astype(np.int32), tree.view_names)

    def save(self, folder: Path) -> None:
        """Write the file to a folder; identical indexes produce identical bytes."""
        values = {**vars(self.tree), "gaussians": self.gaussians, "best_view": self.best_view}
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        about = {name: value for name, value in values.items() if name not in arrays}
        write_tensors(folder / FILE, arrays, **about, views_of_scene=self.views)

    @staticmethod
    def load(folder: Path) -> "NodeIndex":
        """Read the file; raise ArtifactError if it is missing, damaged or from a different version."""
        path = Path(folder) / FILE
        arrays, about = read_tensors(path)
        with readable(path):
            views = tuple(about.pop("views_of_scene"))
            of_index = {name: arrays.pop(name) for name in ("gaussians", "best_view")}
        require_types(NodeIndex, of_index, path, {"best_view": (0, len(views) - 1)})
        about["view_names"] = ()
        return NodeIndex(build_checked(SemanticTree, arrays, about, path, LIMITS), **of_index, views=views)
