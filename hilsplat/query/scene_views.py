"""Nodes and pixels shown by a scene's views; artifacts are opened once, and results are cached per view."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64, UInt8

from hilsplat.base.errors import SettingsError, nearest
from hilsplat.base.levels import LEVELS, NONE, Level, spelt
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.tree import SemanticTree, ViewNodes
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.api import pixel_weights

MIN_VISIBLE_SHARE = 1e-4
"""Minimum share of a view's pixels that a visible node covers; 14 px of 384 x 384 are too few."""

VIEW_CACHE_MIB = 1024.0

Nodes = Sequence[int] | Int64[np.ndarray, " n"]

View = str | Camera  # the name of a view of the scene, or any camera in scene coordinates


class Opened:
    """Artifacts of a scene's variants, which share most; `get(how, *of)` opens or hashes each only once.

    `max_mib` limits the cached results per view of each variant.
    """

    def __init__(self, max_mib: float = VIEW_CACHE_MIB) -> None:
        self.get: Callable[..., Any] = cache(lambda how, *of: how(*of))
        self.max_mib = max_mib


class ViewStore:
    """Cache of results per view; above `max_mib`, the least recently used results are dropped."""

    def __init__(self, max_mib: float = VIEW_CACHE_MIB) -> None:
        self._max_bytes = max_mib * 2**20
        self._values: dict[tuple[Any, ...], tuple[Any, int]] = {}

    def __reduce__(self) -> tuple[type["ViewStore"], tuple[float]]:
        """Start with an empty cache in another process."""
        return ViewStore, (self._max_bytes / 2**20,)

    def get(self, key: tuple[Any, ...], compute: Callable[[], Any]) -> Any:
        """Return the cached value, or compute and cache it; the second item of a key is the view."""
        # Single operations on a dict are atomic, so several threads may read a scene.
        entry = self._values.pop(key, None)
        if entry is None:
            value = compute()
            entry = value, _nbytes(value)
        self._values[key] = entry
        while (
            len(items := list(self._values.items())) > 1
            and sum(item[1][1] for item in items) > self._max_bytes
        ):
            self._values.pop(items[0][0], None)
        return entry[0]

    def forget(self, view: str) -> None:
        """Drop the results of a view."""
        for key in [key for key in list(self._values) if key[1] == view]:
            self._values.pop(key, None)


def _nbytes(value: Any) -> int:
    """Return the bytes of an array, or of the arrays in a list, a tuple or an object's attributes."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, list | tuple):
        return sum(map(_nbytes, value))
    return sum(part.nbytes for part in vars(value).values() if isinstance(part, np.ndarray))


@dataclass(frozen=True)
class SceneViews:
    """The views of a scene, with the Gaussians and nodes that they show; results are cached per view."""

    scene: Scene
    gaussians: Gaussians
    tree: SemanticTree
    threads: int = 1
    cache: ViewStore = field(default_factory=ViewStore, repr=False, compare=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all views, in camera order."""
        return self.scene.cameras.names

    def camera(self, view: View) -> Camera:
        """Return the camera of a view; raise SettingsError if the scene has no such view."""
        if isinstance(view, Camera):
            return view
        if (name := spelt(view, self.names)) is None:
            raise SettingsError(f"{self.scene.name} has no view {view!r}", expected=nearest(view, self.names))
        return self.scene.cameras[name]

    def cached(self, kind: str, view: View, compute: Callable[[], Any], *more: Any) -> Any:
        """Return the cached result for a view of the scene; those of other cameras aren't cached."""
        return self.cache.get((kind, view, *more), compute) if isinstance(view, str) else compute()

    def image(self, view: str) -> UInt8[np.ndarray, "H W 3"]:
        """Return a view's undistorted photograph, a cached read-only array: copy it to change pixels."""
        view = self.camera(view).name

        def read() -> np.ndarray:
            pixels = self.scene.image(view)
            pixels.setflags(write=False)
            return pixels

        return self.cached("image", view, read)

    def pixel_weights(self, view: View) -> sp.csr_matrix:
        """Render a view's weight matrix W (pixels x Gaussians)."""
        camera, min_weight = self.camera(view), self.tree.min_weight
        return pixel_weights(self.gaussians, camera, min_weight=min_weight, threads=self.threads)

    def view_weights(self, view: View) -> sp.csr_matrix:
        """Return W with rows divided by alpha; rows with an alpha below 0.5 are empty."""
        return self.cached("weights", view, lambda: normalised_weights(self.pixel_weights(view)))

    def view_nodes(self, view: View, level: Level) -> ViewNodes:
        """Return the nodes of a level in each pixel of a view."""

        def summed() -> ViewNodes:
            return ViewNodes.of(self.view_weights(view), self.tree.node_of_gaussian[:, level.index])

        return self.cached("nodes", view, summed, level)

    def visible_nodes(self, view: str) -> Bool[np.ndarray, " n"]:
        """Return whether each node's mask covers at least `MIN_VISIBLE_SHARE` of a view."""
        height, width = self.camera(view).size_hw

        def measure() -> np.ndarray:
            num = len(self.tree)
            area_px = np.sum([self.view_nodes(view, level).area_px(num) for level in LEVELS], axis=0)
            return np.asarray(area_px >= MIN_VISIBLE_SHARE * height * width)

        return self.cached("visible", view, measure)

    def gaussians_of(self, ids: Nodes) -> Int64[np.ndarray, " g"]:
        """Return the rows of `gaussians.ply` that belong to any of the nodes; errors as in `existing`."""
        return np.flatnonzero(np.isin(self.tree.node_of_gaussian, self.existing(ids)).any(axis=1))

    def existing(self, ids: Nodes) -> Int64[np.ndarray, " k"]:
        """Return the nodes as an array; raise SettingsError if one does not exist."""
        return _within(ids, len(self.tree), "node")

    def existing_pixels(self, view: View, pixels: Any) -> Int64[np.ndarray, " P"]:
        """Return pixels (row * width + column) as an array; raise SettingsError if one does not exist."""
        return _within(pixels, math.prod(self.camera(view).size_hw), f"pixel of {view}:")

    @property
    def loose(self) -> Bool[np.ndarray, " N"]:
        """Gaussians that belong to no node at any level, such as floaters."""
        return (self.tree.node_of_gaussian == NONE).all(axis=1)

    def node_masks(self, view: View, ids: Nodes) -> Bool[np.ndarray, "H W"]:
        """Return the pixels in which the nodes' Gaussians have more than half of the total weight.

        Errors are those of `camera` and `existing`.
        """
        ids = self.existing(ids)
        size_hw = self.camera(view).size_hw
        if not len(ids):
            return np.zeros(size_hw, np.bool_)
        levels = np.unique(self.tree.level[ids])
        if len(levels) == 1:
            is_chosen = np.isin(np.arange(len(self.tree)), ids)
            return self.view_nodes(view, Level(int(levels[0]))).mask(is_chosen).reshape(size_hw)
        member = np.zeros(len(self.tree.node_of_gaussian), np.float32)
        member[self.gaussians_of(ids)] = 1
        return (self.view_weights(view) @ member > 0.5).reshape(size_hw)

    def blended(self, view: View, scores: Float32[np.ndarray, "T n"]) -> Float32[np.ndarray, "T 3 H W"]:
        """Average node scores over each pixel's Gaussians, weighted by W, at each level.

        Gaussians without a node have the lowest node score of the level, or 0 if it has one node. Uncovered
        pixels get the covered pixels' lowest value, so that they are never selected and do not extend the
        range.
        """
        height, width = self.camera(view).size_hw
        maps = np.zeros((len(scores), len(LEVELS), height * width), np.float32)
        for level in LEVELS:
            nodes = self.tree.nodes_of(level)
            if not len(nodes):
                continue
            in_view = self.view_nodes(view, level)
            for row, values in enumerate(scores):
                lowest = float(values[nodes].min()) if len(nodes) > 1 else 0.0
                in_view.blend(values, lowest, maps[row, level.index])
        return maps.reshape(len(scores), len(LEVELS), height, width)


def _within(numbers: Any, count: int, what: str) -> Int64[np.ndarray, " k"]:
    """Return integers as an array; raise SettingsError if one is not in 0 to `count` - 1."""
    array = np.atleast_1d(np.asarray(numbers))
    are_right = array.ndim == 1 and (array.dtype.kind in "iu" or not array.size)
    if not are_right or not ((array >= 0) & (array < count)).all():
        listed = array.tolist()
        wrong = next((item for item in listed if item not in range(count)), listed[0])
        raise SettingsError(f"{what} {wrong!r} does not exist", expected=f"integers from 0 to {count - 1}")
    return array.astype(np.int64)


def heaviest_node(
    node_of_gaussian: Int32[np.ndarray, " g"], weights: Float[np.ndarray, " g"]
) -> tuple[int, float]:
    """Return the node with the largest total weight, and that weight; -1 and 0 if no Gaussian has a node."""
    total = np.bincount(node_of_gaussian + 1, weights, minlength=1)
    total[0] = 0  # Gaussians without a node
    best = int(total.argmax())
    return best - 1, float(total[best])


def upright(cameras: Cameras) -> Float64[np.ndarray, " 3"]:
    """Return the mean up direction of the cameras (OpenCV: up is -y)."""
    up = -cameras.cam_from_world[:, 1, :3].mean(axis=0)
    length = np.linalg.norm(up)
    return up / length if length > 1e-6 else -cameras.cam_from_world[0, 1, :3]
