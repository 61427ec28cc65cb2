"""What a scene must answer to be scored, and its answers while one view is scored."""

from typing import Protocol, runtime_checkable

import numpy as np

from hilsplat.base.levels import Level


@runtime_checkable
class QueryableScene(Protocol):
    """What a scene must answer (`hilsplat.query.language_scene.LanguageScene` does)."""

    def field_relevancy(self, texts, view):
        """Rendered relevancy, (T, 3, H, W)."""

    def node_relevancy_map(self, texts, view):
        """Relevancy of the node at each pixel, (T, 3, H, W)."""

    def select_nodes(self, text, level=None, threshold=0.95, view=None):
        """Nodes that answer a text, and their level. With a view only nodes that it shows compete."""

    def select_path(self, texts, level=None, threshold=0.95, view=None):
        """Nodes that answer the last of a chain of texts, at a level or at the one chosen; view as above."""

    def node_masks(self, view, ids):
        """Union of the rendered nodes in a view, (H, W)."""


class PackedMasks:
    """Predicted masks of one view, one bit a pixel, kept for what is measured between levels and views."""

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
        height, width = self.size_hw
        return np.unpackbits(self.bits[key], count=height * width).astype(bool).reshape(height, width)


class Selections:
    """Nodes chosen for texts and paths, once for a view or for the whole scene."""

    def __init__(self, scene: QueryableScene, threshold: float) -> None:
        self.scene, self.threshold = scene, threshold
        self._of: dict[tuple, np.ndarray] = {}

    def text(self, text: str, level: Level | None, view: str | None) -> np.ndarray:
        """Ids of the nodes that answer a text at a level, or at the level the tree chooses.

        Nodes that the view shows compete, as maps do; without a view those of the whole scene.
        """
        key = (text, level, view)
        if key not in self._of:
            hits = self.scene.select_nodes(text, level=level, threshold=self.threshold, view=view)
            self._of[key] = np.asarray(hits.ids)
        return self._of[key]

    def path(self, texts: tuple[str, ...], level: Level | None, view: str) -> np.ndarray:
        """Ids of the nodes that answer the last of a chain of texts, at a level or at the one chosen."""
        key = (texts, level, view)
        if key not in self._of:
            hits = self.scene.select_path(texts, level=level, threshold=self.threshold, view=view)
            self._of[key] = np.asarray(hits.ids)
        return self._of[key]

    def mask(self, view: str, ids: np.ndarray, size_hw: tuple[int, int]) -> np.ndarray:
        """Union of some nodes in a view; no node gives an empty mask."""
        if len(ids) == 0:
            return np.zeros(size_hw, dtype=bool)
        return np.asarray(self.scene.node_masks(view, ids)).astype(bool)
