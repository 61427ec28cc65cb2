"""Cached answers of a scene in one view, and their score rows."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float32, Int

from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import Level
from hilsplat.evaluate.metrics import masks
from hilsplat.evaluate.protocols.cards import LERF_LANGSPLAT
from hilsplat.evaluate.protocols.view_truth import Query
from hilsplat.evaluate.scores import Measured

if TYPE_CHECKING:
    from hilsplat.query.language_scene import LanguageScene

NO_POINTS = np.zeros((0, 2), np.int64)  # peak points of an answer without localization


def relevancy_of(
    scene: "LanguageScene", method: str, texts: Sequence[str], view: str
) -> Float32[np.ndarray, "T 3 H W"]:
    """Return the relevancy maps of texts, computed by `method` "field" or "tree".

    Raises:
        ArtifactError: a relevancy is NaN.
    """
    render = scene.field.relevancy if method == "field" else scene.node_relevancy_map
    relevancy = np.asarray(render(tuple(texts), view), dtype=np.float32)
    if np.isnan(relevancy).any():
        raise ArtifactError(
            f"the relevancy of view {view} is NaN at {np.isnan(relevancy).sum()} pixels",
            expected="a finite relevancy everywhere",
            fix="check the scene's field and CLIP vectors for NaN",
        )
    return relevancy


def peaks_of_answer(
    relevancy: Float32[np.ndarray, "L H W"], filtered: Float32[np.ndarray, "L H W"], level: Level | None
) -> Int[np.ndarray, "P 2"]:
    """Return the peaks (x, y) of a level's filtered relevancy, or of the level with the highest one.

    A level without an answer (no latent, no node in the view) has one value everywhere, and no peak.
    """
    searched = range(len(relevancy)) if level is None else (level.index,)
    answered = [index for index in searched if relevancy[index].min() < relevancy[index].max()]
    return masks.peak_points(filtered[answered]) if answered else NO_POINTS


class PackedMasks:
    """Predicted masks of one view at one bit per pixel."""

    def __init__(self, size_hw: tuple[int, int]) -> None:
        self.size_hw = size_hw
        self._bits: dict[object, np.ndarray] = {}

    def put(self, key: object, mask: np.ndarray) -> None:
        self._bits[key] = np.packbits(mask)

    def __contains__(self, key: object) -> bool:
        return key in self._bits

    def get(self, key: object) -> Bool[np.ndarray, "H W"]:
        height, width = self.size_hw
        return np.unpackbits(self._bits[key], count=height * width).astype(bool).reshape(height, width)


class Selections:
    """Nodes selected for texts and paths, cached per view and for the whole scene."""

    def __init__(self, scene: "LanguageScene") -> None:
        self.scene = scene
        self._of: dict[tuple[Any, ...], np.ndarray] = {}
        self._masks: dict[str, PackedMasks] = {}

    def nodes(self, path: tuple[str, ...], level: Level | None, view: str | None) -> np.ndarray:
        """Return the ids of the nodes that answer the last text of a path, ordered from coarse to fine.

        If `level` is None, the tree chooses it. With a view, only nodes visible there compete, as in maps.
        """
        key = (path, level, view)
        if key not in self._of:
            self._of[key] = np.asarray(self.scene.select(path, level=level, view=view).ids)
        return self._of[key]

    def mask(self, view: str, ids: np.ndarray, size_hw: tuple[int, int]) -> np.ndarray:
        """Return the union mask of the given nodes in a view; each set is rendered once for all protocols."""
        if len(ids) == 0:
            return np.zeros(size_hw, dtype=bool)
        masks, key = self._masks.setdefault(view, PackedMasks(size_hw)), ids.tobytes()
        if key not in masks:
            masks.put(key, np.asarray(self.scene.views.node_masks(view, ids)).astype(bool))
        return masks.get(key)


def mask_rows(
    method: str,
    query: Query,
    protocol: str,
    mask: Bool[np.ndarray, "H W"],
    points_xy: Int[np.ndarray, "P 2"] = NO_POINTS,
    metrics: Sequence[str] = LERF_LANGSPLAT.metrics,
) -> Iterator[Measured]:
    """Yield one row per metric for a mask; `points_xy` are the relevancy peaks, for localization."""
    level = query.level.label if query.level else ""
    values = {
        "iou": lambda: masks.iou(mask, query.truth),
        "boundary_iou": lambda: masks.boundary_iou(mask, query.truth),
        "acc_25": lambda: float(masks.iou(mask, query.truth) > 0.25),
        "acc_50": lambda: float(masks.iou(mask, query.truth) > 0.5),
        "localization_box": lambda: float(masks.hits_a_box(points_xy, query.boxes_xyxy)),
        "localization_mask": lambda: float(masks.hits_the_mask(points_xy, query.truth)),
    }
    for metric in metrics:
        yield Measured(method, query.text, level, metric, protocol, values[metric]())
