"""What a scene must answer to be scored, and its answers while one view is scored."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from hilsplat.base.levels import Level


@runtime_checkable
class QueryableScene(Protocol):
    """What a scene must answer (`hilsplat.query.language_scene.LanguageScene` does)."""

    def field_relevancy(self, texts, view):
        """Rendered relevancy, (T, 3, H, W)."""

    def node_relevancy_map(self, texts, view):
        """Relevancy of the node at each pixel, (T, 3, H, W)."""

    def field_cosine(self, texts, view, pixels):
        """Cosine of the decoded latent of some pixels, (T, 3, P); -inf where a level does not answer."""

    def node_cosine(self, texts, view, pixels):
        """Cosine of the node at some pixels, (T, 3, P); -inf where a level does not answer."""

    def select(self, path, *, level=None, view=None):
        """Nodes that answer the last of one or more texts, at a given or a chosen level. With a view, only
        the nodes that it shows compete."""

    def node_masks(self, view, ids):
        """Union of the rendered nodes in a view, (H, W)."""


@dataclass(frozen=True)
class ViewMaps:
    """What one method's maps of one view say of any texts.

    Attributes:
        relevancy: texts -> relevancy, (T, 3, H, W).
        cosine: texts and pixels (row * width + column) -> plain cosine, (T, 3, P); -inf where a level does
            not answer.
    """

    relevancy: Callable[[Sequence[str]], Float32[np.ndarray, "T 3 H W"]]
    cosine: Callable[[Sequence[str], Int64[np.ndarray, " P"]], Float32[np.ndarray, "T 3 P"]]


class PackedMasks:
    """Predicted masks of one view, one bit per pixel, kept for measures across levels and views."""

    def __init__(self, size_hw: tuple[int, int]) -> None:
        self.size_hw = size_hw
        self.bits: dict[tuple, np.ndarray] = {}

    def put(self, key: tuple, mask: np.ndarray) -> None:
        """Keep a mask."""
        self.bits[key] = np.packbits(mask)

    def __contains__(self, key: tuple) -> bool:
        return key in self.bits

    def get(self, key: tuple) -> np.ndarray:
        """Unpack a mask."""
        return unpacked(self.bits[key], self.size_hw)


def unpacked(bits: UInt8[np.ndarray, " B"], size_hw: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """The mask that `numpy.packbits` packed."""
    return np.unpackbits(bits, count=size_hw[0] * size_hw[1]).astype(bool).reshape(size_hw)


class Selections:
    """Nodes chosen for texts and paths, each found once per view or for the whole scene."""

    def __init__(self, scene: QueryableScene) -> None:
        self.scene = scene
        self._of: dict[tuple, np.ndarray] = {}
        self._masks: dict[tuple[str, bytes], np.ndarray] = {}

    def nodes(self, path: tuple[str, ...], level: Level | None, view: str | None) -> np.ndarray:
        """Ids of the nodes that answer a text, or the last text of a path.

        Args:
            path: one text, or several from coarse to fine.
            level: level of the last text; None lets the tree choose.
            view: only the nodes that it shows compete, as in maps; None: those of the whole scene.
        """
        key = (path, level, view)
        if key not in self._of:
            self._of[key] = np.asarray(self.scene.select(path, level=level, view=view).ids)
        return self._of[key]

    def mask(self, view: str, ids: np.ndarray, size_hw: tuple[int, int]) -> np.ndarray:
        """Union of some nodes in a view; no nodes give an empty mask.

        Protocols ask for the same nodes again and again: each union is rendered once, and kept in bits.
        """
        if len(ids) == 0:
            return np.zeros(size_hw, dtype=bool)
        key = (view, ids.tobytes())
        if key not in self._masks:
            self._masks[key] = np.packbits(np.asarray(self.scene.node_masks(view, ids)).astype(bool))
        return unpacked(self._masks[key], size_hw)
