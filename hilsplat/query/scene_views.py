"""Nodes and pixels that a scene's views show; slow results are cached per view."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32, Int64, UInt8

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.query.caches import ViewStore
from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.semantic_tree.view_nodes import ViewNodes

MIN_SHOWN_SHARE = 1e-4
"""Minimum share of a view that shows a node: 14 px of 384 x 384 are too few."""


@dataclass(frozen=True)
class SceneViews:
    """The views of a scene with a semantic tree; `pixel_weights` returns W of a view (pixels x Gaussians)."""

    scene: Scene
    tree: SemanticTree
    pixel_weights: Callable[[str], sp.csr_matrix]
    store: ViewStore

    def camera(self, view: str) -> Camera:
        """Return the camera of a view.

        Raises:
            SettingsError: the scene has no such view.
        """
        names = self.scene.cameras.names
        if view not in names:
            raise SettingsError(
                f"{self.scene.name} has no view {view!r}",
                expected=f"one of {', '.join(names[:3])}, ... ({len(names)} views)",
                found=view,
            )
        return self.scene.cameras[view]

    def image(self, view: str) -> UInt8[np.ndarray, "H W 3"]:
        """Return the undistorted photograph of a view, read-only."""
        self.camera(view)

        def read() -> np.ndarray:
            pixels = self.scene.image(view)
            pixels.setflags(write=False)
            return pixels

        return self.store.get(("image", view), read, lambda kept: kept.nbytes)

    def weights(self, view: str) -> sp.csr_matrix:
        """Return W of a view with rows divided by alpha; rows with an alpha below 0.5 are empty."""
        return self.store.get(
            ("weights", view),
            lambda: normalised_weights(self.pixel_weights(view)),
            lambda kept: kept.data.nbytes + kept.indices.nbytes + kept.indptr.nbytes,
        )

    def nodes(self, view: str, level: Level) -> ViewNodes:
        """Return the nodes of a level in each pixel of a view."""
        return self.store.get(
            ("nodes", view, level),
            lambda: ViewNodes.of(self.weights(view), self.tree.node_of_gaussian[:, level.index]),
            lambda kept: kept.nbytes,
        )

    def shown(self, view: str) -> Bool[np.ndarray, " n"]:
        """Return which nodes have a mask of at least `MIN_SHOWN_SHARE` of a view."""
        height, width = self.camera(view).size_hw

        def measure() -> np.ndarray:
            num = len(self.tree)
            area_px = np.sum([self.nodes(view, level).area_px(num) for level in LEVELS], axis=0)
            return np.asarray(area_px >= MIN_SHOWN_SHARE * height * width)

        return self.store.get(("shown", view), measure, lambda kept: kept.nbytes)

    def masks(self, view: str, ids: Sequence[int] | Int64[np.ndarray, " n"]) -> Bool[np.ndarray, "H W"]:
        """Return the pixels in which the nodes' Gaussians have a share above 0.5."""
        ids = np.asarray(ids, np.int64)
        height, width = self.camera(view).size_hw
        if not len(ids):
            return np.zeros((height, width), np.bool_)
        chosen = np.zeros(len(self.tree), np.bool_)
        chosen[ids] = True
        levels = np.unique(self.tree.level[ids])
        if len(levels) == 1:
            return self.nodes(view, Level(int(levels[0]))).mask(chosen).reshape(height, width)
        member = np.zeros(len(self.tree.node_of_gaussian), np.float32)
        member[members_of(self.tree, ids)] = 1
        return (self.weights(view) @ member > 0.5).reshape(height, width)

    def blended(self, view: str, scores: Float32[np.ndarray, "T n"]) -> Float32[np.ndarray, "T 3 H W"]:
        """Blend the scores of the nodes that each pixel shows by its weights, at each level.

        Gaussians without a node get the lowest node score of the level. Uncovered pixels get the lowest value
        of the covered ones, so that they are never selected and do not stretch the range.
        """
        height, width = self.camera(view).size_hw
        maps = np.zeros((len(scores), len(LEVELS), height * width), np.float32)
        for level in LEVELS:
            nodes = self.tree.nodes_of(level)
            if not len(nodes):
                continue
            shown = self.nodes(view, level)
            for row, values in enumerate(scores):
                shown.blend(values, float(values[nodes].min()), maps[row, level.index])
        return maps.reshape(len(scores), len(LEVELS), height, width)


def members_of(tree: SemanticTree, ids: Sequence[int] | Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " g"]:
    """Return the Gaussians that belong to any of the nodes."""
    return np.flatnonzero(np.isin(tree.node_of_gaussian, np.asarray(ids)).any(axis=1))
