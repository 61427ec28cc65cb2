"""Interface that a scene must implement to be scored, and caches of its answers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from hilsplat.base.levels import Level


@runtime_checkable
class QueryableScene(Protocol):
    """Methods that scoring calls; `hilsplat.query.language_scene.LanguageScene` implements them."""

    def field_relevancy(self, texts, view):
        """Return the rendered relevancy, (T, 3, H, W)."""

    def node_relevancy_map(self, texts, view):
        """Return the relevancy of the node at each pixel, (T, 3, H, W)."""

    def field_cosine(self, texts, view, pixels):
        """Return the cosine of the decoded latent at given pixels, (T, 3, P); -inf at levels without one."""

    def node_cosine(self, texts, view, pixels):
        """Return the cosine of the node at given pixels, (T, 3, P); -inf at levels without one."""

    def select(self, path, *, level=None, view=None):
        """Return the nodes that answer the last text of a path.

        The tree chooses the level if none is given. With a view, only nodes visible in it compete."""

    def node_masks(self, view, ids):
        """Return the union of the nodes rendered in a view, (H, W)."""


@dataclass(frozen=True)
class ViewMaps:
    """Functions that compute one method's maps of one view for any texts.

    Pixels are row * width + column; the plain cosine is -inf at levels without one.
    """

    relevancy: Callable[[Sequence[str]], Float32[np.ndarray, "T 3 H W"]]
    cosine: Callable[[Sequence[str], Int64[np.ndarray, " P"]], Float32[np.ndarray, "T 3 P"]]


class PackedMasks:
    """Predicted masks of one view at one bit per pixel, for measures across levels and views."""

    def __init__(self, size_hw: tuple[int, int]) -> None:
        self.size_hw = size_hw
        self.bits: dict[tuple, np.ndarray] = {}

    def put(self, key: tuple, mask: np.ndarray) -> None:
        """Store a mask."""
        self.bits[key] = np.packbits(mask)

    def __contains__(self, key: tuple) -> bool:
        return key in self.bits

    def get(self, key: tuple) -> np.ndarray:
        """Return a mask, unpacked."""
        return unpacked(self.bits[key], self.size_hw)


def unpacked(bits: UInt8[np.ndarray, " B"], size_hw: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Return the mask that `numpy.packbits` packed."""
    return np.unpackbits(bits, count=size_hw[0] * size_hw[1]).astype(bool).reshape(size_hw)


class Selections:
    """Nodes selected for texts and paths, cached per view and for the whole scene."""

    def __init__(self, scene: QueryableScene) -> None:
        self.scene = scene
        self._of: dict[tuple, np.ndarray] = {}
        self._masks: dict[tuple[str, bytes], np.ndarray] = {}

    def nodes(self, path: tuple[str, ...], level: Level | None, view: str | None) -> np.ndarray:
        """Return the ids of the nodes that answer a text, or the last text of a path.

        Args:
            path: one text, or several from coarse to fine.
            level: level of the last text; None if the tree chooses it.
            view: only nodes visible in it compete, as in maps; None if all nodes of the scene compete.
        """
        key = (path, level, view)
        if key not in self._of:
            self._of[key] = np.asarray(self.scene.select(path, level=level, view=view).ids)
        return self._of[key]

    def mask(self, view: str, ids: np.ndarray, size_hw: tuple[int, int]) -> np.ndarray:
        """Return the union of the given nodes in a view, empty without nodes.

        Several protocols request the same nodes, so each union is rendered once and cached as packed bits.
        """
        if len(ids) == 0:
            return np.zeros(size_hw, dtype=bool)
        key = (view, ids.tobytes())
        if key not in self._masks:
            self._masks[key] = np.packbits(np.asarray(self.scene.node_masks(view, ids)).astype(bool))
        return unpacked(self._masks[key], size_hw)
