"""Protocols: what is asked of one view, and how each answer becomes rows.

| protocol | queries | answer |
|---|---|---|
| `langsplat_lerf` | every distinct text; regions of all levels united | field; level chosen by the rule |
| `node_selection` | the same | tree; level chosen by the tree |
| `hierarchy:level=given` | every (text, level) | field or tree, at the annotation's level |
| `hierarchy:level=auto` | every (text, level) | field or tree, level chosen by the method |
| `hierarchy:path` | every (text, level), asked as the chain of texts from the whole down | tree |
| `hierarchy:annotations` | - | the annotations themselves, HC only: what perfect masks would score |

A path holds one more piece of information than a flat query and is not the paper's protocol. A missing
or empty prediction counts 0.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Int

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.evaluate.metrics.hierarchy import READINGS, Family, hierarchical_consistency
from hilsplat.evaluate.metrics.localization import box_of, hits_a_box, hits_the_mask, peak_points
from hilsplat.evaluate.metrics.masks import best_threshold_iou, boundary_iou, iou
from hilsplat.evaluate.metrics.relevancy_rule import (
    RelevancyRule,
    SmoothedRelevancy,
    filter_side_px,
    mean_filter,
    relevancy_mask,
)
from hilsplat.settings import EvaluateSettings

GIVEN = "hierarchy:level=given"
AUTO = "hierarchy:level=auto"
PATH = "hierarchy:path"
ANNOTATIONS = "hierarchy:annotations"
NODES = "node_selection"
RELEVANCY_CHUNK_MIB = 128
"""Relevancy maps of so many texts are held at once."""


@runtime_checkable
class QueryableScene(Protocol):
    """What a scene must answer (`hilsplat.language.query.LanguageScene` does)."""

    def field_relevancy(self, texts, view):
        """Rendered relevancy, (T, 3, H, W)."""

    def node_relevancy_map(self, texts, view):
        """Relevancy of the node at each pixel, (T, 3, H, W)."""

    def select_nodes(self, text, level=None, threshold=0.85, within=None):
        """Nodes that answer a text, with the level they are of."""

    def select_path(self, texts, threshold=0.85):
        """Nodes that answer the last of a chain of texts."""

    def node_masks(self, view, ids):
        """Union of the rendered nodes in a view, (H, W)."""


@dataclass(frozen=True)
class Query:
    """One annotated text in one view.

    Attributes:
        text: what is asked.
        level: level of its annotation; None where the protocol unites levels.
        paths: chains of texts that lead to its nodes, each once.
        truth: true region.
        boxes_xyxy: box of each annotated node, borders included.
    """

    text: str
    level: Level | None
    paths: tuple[tuple[str, ...], ...]
    truth: Bool[np.ndarray, "H W"]
    boxes_xyxy: Int[np.ndarray, "B 4"]


@dataclass(frozen=True)
class ViewTruth:
    """Everything that is scored in one view.

    Attributes:
        queries: one per (text, level).
        categories: one per text, levels united.
        regions: true region of each path that is large enough.
    """

    queries: tuple[Query, ...]
    categories: tuple[Query, ...]
    regions: dict[tuple[str, ...], Bool[np.ndarray, "H W"]]

    @staticmethod
    def of(
        annotations: HierarchyAnnotations, view: str, size_hw: tuple[int, int], min_px: int
    ) -> "ViewTruth":
        """Collect the regions of at least `min_px` pixels.

        Raises:
            MisalignedArtifactError: the label images are of another size than the camera.
        """
        queries: list[Query] = []
        by_path: dict[tuple[str, ...], np.ndarray] = {}
        for level in LEVELS:
            texts = annotations.texts(view, level)
            if not texts:
                continue
            labels = annotations.label_image(view, level)
            if labels.shape != tuple(size_hw):
                raise MisalignedArtifactError(
                    f"label image of view {view}, level {level.label}, does not fit its camera",
                    expected=f"{size_hw[0]} x {size_hw[1]} (height x width)",
                    found=f"{labels.shape[0]} x {labels.shape[1]}",
                    fix="annotate the images of the scene folder, or run poses without shrinking them",
                )
            for text, ids in texts.items():
                regions = {node: labels == node for node in ids}
                truth = np.any(list(regions.values()), axis=0)
                if np.count_nonzero(truth) < min_px:
                    continue
                boxes = np.stack([box_of(region) for region in regions.values() if region.any()])
                paths = tuple(dict.fromkeys(annotations.path_of(node) for node in ids))
                queries.append(Query(text, level, paths, truth, boxes))
                for node, region in regions.items():
                    path = annotations.path_of(node)
                    by_path[path] = by_path[path] | region if path in by_path else region
        categories = []
        for text in dict.fromkeys(query.text for query in queries):
            same = [query for query in queries if query.text == text]
            categories.append(
                Query(
                    text,
                    None,
                    tuple(path for query in same for path in query.paths),
                    np.any([query.truth for query in same], axis=0),
                    np.concatenate([query.boxes_xyxy for query in same]),
                )
            )
        large = {path: region for path, region in by_path.items() if np.count_nonzero(region) >= min_px}
        return ViewTruth(tuple(queries), tuple(categories), large)

    def families(self) -> list[list[tuple[tuple[str, ...], list[tuple[str, ...]]]]]:
        """(parent path, child paths) per transition whole -> part, part -> subpart."""
        transitions: list[list[tuple[tuple[str, ...], list[tuple[str, ...]]]]] = []
        for depth in range(1, len(LEVELS)):
            families = []
            for parent in (path for path in self.regions if len(path) == depth):
                children = [path for path in self.regions if path[:-1] == parent]
                if children:
                    families.append((parent, children))
            transitions.append(families)
        return transitions


@dataclass(frozen=True)
class Measured:
    """One number before scene and variant are known."""

    method: str
    query: str
    level: str
    metric: str
    protocol: str
    value: float
    n: int = 1


class PackedMasks:
    """Predicted masks of one view, one bit a pixel, kept for hierarchical consistency."""

    def __init__(self, size_hw: tuple[int, int]) -> None:
        self.size_hw = size_hw
        self.bits: dict[tuple, np.ndarray] = {}

    def put(self, key: tuple, mask: np.ndarray) -> None:
        """Keep a mask."""
        self.bits[key] = np.packbits(mask)

    def get(self, key: tuple) -> np.ndarray:
        """Unpack a mask."""
        height, width = self.size_hw
        return np.unpackbits(self.bits[key], count=height * width).astype(bool).reshape(height, width)


class Selections:
    """Nodes chosen for texts and paths; they do not depend on the view, so each is chosen once."""

    def __init__(self, scene: QueryableScene, threshold: float) -> None:
        self.scene, self.threshold = scene, threshold
        self._of: dict[tuple, np.ndarray] = {}

    def text(self, text: str, level: Level | None) -> np.ndarray:
        """Ids of the nodes that answer a text at a level, or at the level the tree chooses."""
        key = (text, level)
        if key not in self._of:
            hits = self.scene.select_nodes(text, level=level, threshold=self.threshold)
            self._of[key] = np.asarray(hits.ids)
        return self._of[key]

    def path(self, texts: tuple[str, ...]) -> np.ndarray:
        """Ids of the nodes that answer a chain of texts."""
        if texts not in self._of:
            self._of[texts] = np.asarray(self.scene.select_path(texts, threshold=self.threshold).ids)
        return self._of[texts]

    def mask(self, view: str, ids: np.ndarray, size_hw: tuple[int, int]) -> np.ndarray:
        """Union of some nodes in a view; no node gives an empty mask."""
        if len(ids) == 0:
            return np.zeros(size_hw, dtype=bool)
        return np.asarray(self.scene.node_masks(view, ids)).astype(bool)


def rule_of(settings: EvaluateSettings) -> RelevancyRule:
    """The map rule that the settings ask for."""
    return RelevancyRule(
        settings.filter_px,
        settings.mix,
        settings.relevancy_threshold,
        settings.threshold_on,
        settings.majority,
        settings.level_rule,
    )


def measure_view(
    scene: QueryableScene,
    selections: Selections,
    truth: ViewTruth,
    view: str,
    size_hw: tuple[int, int],
    settings: EvaluateSettings,
) -> Iterator[Measured]:
    """All numbers of one view, in no particular order."""
    rule = rule_of(settings)
    masks = PackedMasks(size_hw)
    texts = [query.text for query in truth.categories]
    per_chunk = max(1, int(RELEVANCY_CHUNK_MIB * 2**20 / (2 * 3 * 4 * size_hw[0] * size_hw[1])))
    for start in range(0, len(texts), per_chunk):
        chunk = texts[start : start + per_chunk]
        fields = _relevancy(scene.field_relevancy, chunk, view) if "field" in settings.methods else None
        asks_nodes = {"tree", "tree-path"} & set(settings.methods)
        nodes = _relevancy(scene.node_relevancy_map, chunk, view) if asks_nodes else None
        for row, text in enumerate(chunk):
            queries = [query for query in (*truth.categories, *truth.queries) if query.text == text]
            if fields is not None:
                yield from _field_rows(fields[row], queries, rule, masks)
            if nodes is not None and "tree" in settings.methods:
                yield from _tree_rows(nodes[row], queries, rule, selections, view, masks)
            if nodes is not None and "tree-path" in settings.methods:
                yield from _path_rows(nodes[row], queries, rule, selections, view, masks)
    yield from _consistency_rows(truth, masks, settings.methods)


def _relevancy(render, texts: Sequence[str], view: str) -> np.ndarray:
    return np.asarray(render(tuple(texts), view), dtype=np.float32)


def _rows(
    method: str, query: Query, protocol: str, mask: np.ndarray, points_xy: np.ndarray
) -> Iterator[Measured]:
    """IoU, boundary IoU and localization of one answer."""
    level = query.level.label if query.level else ""
    values = {
        "iou": iou(mask, query.truth),
        "boundary_iou": boundary_iou(mask, query.truth),
        "localization_box": float(hits_a_box(points_xy, query.boxes_xyxy)),
        "localization_mask": float(hits_the_mask(points_xy, query.truth)),
    }
    for metric, value in values.items():
        yield Measured(method, query.text, level, metric, protocol, value)


def _best_row(method: str, query: Query, protocol: str, mixed: np.ndarray) -> Measured:
    level = query.level
    assert level is not None
    value = best_threshold_iou(mixed[level.index], query.truth)
    return Measured(method, query.text, level.label, "best_threshold_iou", protocol, value)


def _field_rows(
    relevancy: np.ndarray, queries: Sequence[Query], rule: RelevancyRule, masks: PackedMasks
) -> Iterator[Measured]:
    smoothed = SmoothedRelevancy.of(relevancy, rule)
    auto_mask, _ = relevancy_mask(smoothed, None, rule)
    auto_points, _ = peak_points(smoothed.filtered, None)
    for query in queries:
        if query.level is None:
            yield from _rows("field", query, rule.name, auto_mask, auto_points)
            masks.put(("field", AUTO, query.text), auto_mask)
            continue
        given_mask, _ = relevancy_mask(smoothed, query.level, rule)
        given_points, _ = peak_points(smoothed.filtered, query.level)
        yield from _rows("field", query, GIVEN, given_mask, given_points)
        yield from _rows("field", query, AUTO, auto_mask, auto_points)
        yield _best_row("field", query, GIVEN, smoothed.mixed)
        masks.put(("field", GIVEN, query.text, query.level), given_mask)


def _tree_rows(
    relevancy: np.ndarray,
    queries: Sequence[Query],
    rule: RelevancyRule,
    selections: Selections,
    view: str,
    masks: PackedMasks,
) -> Iterator[Measured]:
    smoothed = SmoothedRelevancy.of(relevancy, rule)
    size_hw = masks.size_hw
    auto_mask = selections.mask(view, selections.text(queries[0].text, None), size_hw)
    auto_points, _ = peak_points(smoothed.filtered, None)
    for query in queries:
        if query.level is None:
            yield from _rows("tree", query, NODES, auto_mask, auto_points)
            masks.put(("tree", AUTO, query.text), auto_mask)
            continue
        given_mask = selections.mask(view, selections.text(query.text, query.level), size_hw)
        given_points, _ = peak_points(smoothed.filtered, query.level)
        yield from _rows("tree", query, GIVEN, given_mask, given_points)
        yield from _rows("tree", query, AUTO, auto_mask, auto_points)
        yield _best_row("tree", query, GIVEN, smoothed.mixed)
        masks.put(("tree", GIVEN, query.text, query.level), given_mask)


def _path_rows(
    relevancy: np.ndarray,
    queries: Sequence[Query],
    rule: RelevancyRule,
    selections: Selections,
    view: str,
    masks: PackedMasks,
) -> Iterator[Measured]:
    """Localization looks inside the prediction for the parent, where there is one."""
    size_hw = masks.size_hw
    side_px = filter_side_px(rule.filter_px, size_hw[0])
    for query in queries:
        if query.level is None:
            continue
        mask = np.zeros(size_hw, dtype=bool)
        inside = np.zeros(size_hw, dtype=bool)
        for path in query.paths:
            path_mask = selections.mask(view, selections.path(path), size_hw)
            masks.put(("tree-path", PATH, path), path_mask)
            mask |= path_mask
            if len(path) > 1:
                inside |= selections.mask(view, selections.path(path[:-1]), size_hw)
        level_map = relevancy[query.level.index]
        filtered = mean_filter(np.where(inside, level_map, 0) if inside.any() else level_map, side_px)
        points, _ = peak_points(np.stack([filtered] * len(LEVELS)), query.level)
        yield from _rows("tree-path", query, PATH, mask, points)


def _consistency_rows(truth: ViewTruth, masks: PackedMasks, methods: Sequence[str]) -> Iterator[Measured]:
    """HC of every method and of the annotations; a view without any parent gives no row."""
    transitions = truth.families()
    parents = sum(map(len, transitions))
    if not parents:
        return
    lookups = {("truth", ANNOTATIONS): lambda path: truth.regions[path]}
    for method in ("field", "tree"):
        if method in methods:
            lookups[method, AUTO] = lambda path, m=method: masks.get((m, AUTO, path[-1]))
            lookups[method, GIVEN] = lambda path, m=method: masks.get((m, GIVEN, path[-1], Level(len(path))))
    if "tree-path" in methods:
        lookups["tree-path", PATH] = lambda path: masks.get(("tree-path", PATH, path))
    for (method, protocol), mask_of in lookups.items():
        families = [
            [
                Family(mask_of(parent), tuple(mask_of(child) for child in children), truth.regions[parent])
                for parent, children in transition
            ]
            for transition in transitions
        ]
        for reading in READINGS:
            value = hierarchical_consistency(families, reading)
            yield Measured(method, "", "", f"hc_{reading}", protocol, value, parents)
