"""Ground truth of one view: its scored queries and their regions, loaded on demand."""

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, Int64
from PIL import Image

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.datasets.labelled import LabelledRegion, LabelledScene
from hilsplat.evaluate.protocols.cards import MIN_REGION_PX
from hilsplat.scene.scene import Scene

logger = logging.getLogger(__name__)

EIGHTH = 8  # 3D-OVS compares masks at one eighth of the height and width of the data set's image


@dataclass(frozen=True)
class Query:
    """One annotated text in one view."""

    text: str
    level: Level | None  # of the annotation; None if merged over levels
    paths: tuple[tuple[str, ...], ...]  # distinct chains of texts that lead to the annotated nodes
    truth: Bool[np.ndarray, "H W"]
    boxes_xyxy: Int[np.ndarray, "B 4"]  # of each annotated node, borders included
    eighth: Bool[np.ndarray, "h w"]  # at one eighth of the data set's image, resized from the label
    any_grey: Bool[np.ndarray, "H W"]  # region for protocols with the ground truth `any grey`

    def region(self, truth: str) -> Bool[np.ndarray, "H W"]:
        return self.any_grey if truth == "any grey" else self.truth


@dataclass(frozen=True)
class ViewTruth:
    """Everything that is scored in one view."""

    queries: tuple[Query, ...]  # one per (text, level)
    categories: tuple[Query, ...]  # one per text, merged over levels
    regions: dict[tuple[str, ...], Bool[np.ndarray, "H W"]]  # of each path that is large enough
    # Texts that are labelled but not visible in the view compete in an argmax, and may have `any_grey`.
    absent: tuple[Query, ...]
    texts: frozenset[tuple[Level | None, str]]  # labelled in the view, also in regions that are too small
    min_px: int  # minimum area of a scored region

    @staticmethod
    def of(
        annotations: HierarchyAnnotations, view: str, size_hw: tuple[int, int], min_px: int
    ) -> "ViewTruth":
        """Collect the annotated regions of at least `min_px` pixels.

        Raises:
            MisalignedArtifactError: label images and camera differ in size.
        """
        regions: list[LabelledRegion] = []
        for level in LEVELS:
            texts = annotations.texts(view, level)
            if not texts:
                continue
            labels = annotations.label_image(view, level)
            if labels.shape != tuple(size_hw):
                raise MisalignedArtifactError(
                    f"the {level.label} label image of view {view} does not match its camera's size",
                    expected=f"{size_hw[0]} x {size_hw[1]} (height x width)",
                    found=f"{labels.shape[0]} x {labels.shape[1]}",
                    fix="annotate the images in the scene folder, or run poses without shrinking them",
                )
            for text, ids in texts.items():
                for node in ids:
                    pixels, path = partial(np.equal, labels, node), annotations.path_of(node)
                    regions.append(LabelledRegion(text, labels.shape, pixels, level=level, path=path))
        return ViewTruth.of_regions(regions, size_hw, min_px=min_px)

    @staticmethod
    def of_regions(
        regions: Iterable[LabelledRegion],
        size_hw: tuple[int, int],
        image_hw: tuple[int, int] | None = None,
        min_px: int = 0,
    ) -> "ViewTruth":
        """Return the ground truth of a view from its regions, with or without levels.

        Regions of one text and level are merged; all boxes are kept. A region with a broken chain of
        parents is queried but belongs to no family.

        Args:
            size_hw: size of the predictions; labels of a different size are resized by nearest neighbour.
            image_hw: size of the data set's image, if it differs from `size_hw`, as after
                `poses.max_side_px`. It determines `Query.eighth`, so scores don't depend on the predictions'
                size.
            min_px: texts and paths with fewer pixels in the view are omitted.
        """
        height, width = image_hw or size_hw
        small_hw = max(1, height // EIGHTH), max(1, width // EIGHTH)
        single: list[Query] = []
        by_path: dict[tuple[str, ...], np.ndarray] = {}
        for region in regions:
            mask, path, level = region.mask(size_hw), region.path, region.level
            if level is not None and not mask.any():
                continue
            grey = region.mask(size_hw, any_grey=True) if region.any_grey else mask
            small = region.pixels().reshape(-1)[kept_by_pillow(region.size_hw, small_hw)]
            single.append(Query(region.text, level, (path,), mask, region.boxes(size_hw), small, grey))
            if level is not None and len(path) == int(level):
                by_path[path] = by_path[path] | mask if path in by_path else mask
        merged = _merged(single, by_level=True)
        queries = [query for query in merged if np.count_nonzero(query.truth) >= min_px]
        united = _merged(queries, by_level=False)
        return ViewTruth(
            tuple(query for query in queries if query.level is not None),
            tuple(query for query in united if query.truth.any()),
            {path: mask for path, mask in by_path.items() if np.count_nonzero(mask) >= min_px},
            tuple(query for query in united if not query.truth.any()),
            frozenset((query.level, query.text) for query in merged),
            min_px,
        )

    @property
    def departures(self) -> list[str]:
        """Return a description of the minimum area, for protocol names, unless it is the default or none."""
        return [] if self.min_px in (0, MIN_REGION_PX) else [f"regions from {self.min_px} px"]

    def own_part(self, path: tuple[str, ...], answer: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """Return the answer to a part, minus the area of other annotated wholes that have the same part.

        The answer to "leg" covers chair and table legs; the chair's part excludes the annotated table.
        """
        parent = path[:-1]
        alike = [other for other in self.regions if len(other) == len(path) > 1 and other[-1] == path[-1]]
        parents = {other[:-1] for other in alike} - {parent}
        others = [self.regions[other] for other in parents if other in self.regions]
        if not others or parent not in self.regions:
            return answer
        return answer & ~(np.any(others, axis=0) & ~self.regions[parent])

    def families(self) -> list[list[tuple[tuple[str, ...], list[tuple[str, ...]]]]]:
        """Return (parent path, child paths) pairs, by transition: whole -> part, then part -> subpart."""
        children: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
        for path in self.regions:
            children.setdefault(path[:-1], []).append(path)
        parents = [path for path in self.regions if path in children]
        return [
            [(parent, children[parent]) for parent in parents if len(parent) == depth]
            for depth in range(1, len(LEVELS))
        ]


def _merged(queries: Iterable[Query], by_level: bool) -> tuple[Query, ...]:
    groups: dict[tuple[str, Level | None], list[Query]] = {}
    for query in queries:
        groups.setdefault((query.text, query.level if by_level else None), []).append(query)
    merged = []
    for (text, level), same in groups.items():
        paths = tuple(dict.fromkeys(path for query in same for path in query.paths))
        boxes = np.concatenate([query.boxes_xyxy for query in same])
        truth, eighth, grey = (
            np.any([getattr(query, name) for query in same], axis=0)
            for name in ("truth", "eighth", "any_grey")
        )
        merged.append(Query(text, level, paths, truth, boxes, eighth, grey))
    return tuple(merged)


@cache
def kept_by_pillow(old_hw: tuple[int, int], new_hw: tuple[int, int]) -> Int64[np.ndarray, "h w"]:
    """Return the pixels (row * width + column) kept by Pillow's nearest-neighbour resizing, as in 3D-OVS."""
    pixels = Image.fromarray(np.arange(math.prod(old_hw), dtype=np.int32).reshape(old_hw))
    return np.asarray(pixels.resize(new_hw[::-1], Image.Resampling.NEAREST)).astype(np.int64)


def truths_of(
    known: LabelledScene | Path, posed: Scene, min_region_px: int
) -> dict[str, Callable[[], ViewTruth]]:
    """Return the ground-truth regions by view, loaded on demand.

    For a synthetic scene (a ground-truth folder), these are the regions of at least `min_region_px` pixels in
    annotated test views; for other labels, all regions in all labelled views that have a pose. Labels drawn
    on photographs with lens distortion are transferred to the undistorted views.

    Raises:
        SceneError: too few labelled views have a pose (`LabelledScene.check_posed`).
        MisalignedArtifactError: labels and view differ in aspect ratio.
    """
    truths: dict[str, Callable[[], ViewTruth]] = {}
    if isinstance(known, Path):
        annotations = HierarchyAnnotations.load(known)
        for view in posed.views("test"):
            if annotations.views.get(view):
                size_hw = posed.cameras[view].size_hw
                truths[view] = partial(ViewTruth.of, annotations, view, size_hw, min_region_px)
        return truths
    name = f"{known.dataset}/{known.scene}"
    for sentence in known.warnings:
        logger.warning("%s: %s", name, sentence)
    for view in known.check_posed(posed.cameras.names):
        camera, where = posed.cameras[view], f"a label of view {view}"
        regions = [region.on(camera, where) for region in known.views[view]]
        truths[view] = partial(ViewTruth.of_regions, regions, camera.size_hw, known.image_hw(view))
    return truths
