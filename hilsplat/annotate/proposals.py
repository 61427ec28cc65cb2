"""Outlines that the user can accept or correct: from nodes, masks, labels in other views, or SAM clicks.

The user must accept a proposal: ground truth copied from a prediction would measure nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool

from hilsplat.annotate.labels import Label, traced
from hilsplat.base.artifacts import read_index
from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.query.names import read_names
from hilsplat.query.scene_views import ViewStore, heaviest_node
from hilsplat.scene.scene import Scene
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import HEADS, SamModel, enlarged, point_grid
from hilsplat.segment.suppression import box_iou
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights

MIN_PX = 20  # minimum area of a proposal; smaller proposals are noise
MIN_SHARE = 0.05
"""Minimum area of a proposal's pieces and holes, relative to the proposal; smaller ones are noise."""
SMOOTH_PX = 1.0
"""Maximum deviation of a proposal's outline from its pixels, px; simple outlines are easier to correct."""
MAX_MASKS = 6
MIN_SEEN = 0.25
"""Minimum weight, in a pixel, of Gaussians visible in annotated views, when transferring objects."""
VIEWS_MIB = 512.0
CACHED_VIEWS = 3
"""Number of photographs whose SAM features are cached: 4 MB each for ViT-B, up to 40 MB for SAM 2."""
BOX_GRID = 4  # number of prompt points along each side of a box; not all SAM exports accept boxes as prompts
MAX_OUTLINES = 3
SAME_IOU = 0.9  # minimum IoU of two masks that count as the same mask


@dataclass(frozen=True)
class Proposal:
    """An outline and its source, such as "node 12" or "mask 3"; `text` is the node's user-given name."""

    what: str
    text: str
    level: int
    polygons: list[list[tuple[int, int]]]


class Proposals:
    """Proposals in a scene's views, from the existing parts of the scene's folder. Not thread-safe."""

    def __init__(self, scene: Scene, folder: Path, variant: str, threads: int) -> None:
        self.scene, self.threads = scene, threads
        self.masks = Path(folder) / variant / "masks"
        semantic_tree = Path(folder) / variant / "semantic_tree"
        ply = Path(folder) / "gaussians.ply"
        self.gaussians: Gaussians | None = load_ply(ply) if ply.is_file() else None
        has_tree = self.gaussians is not None and (semantic_tree / "index.json").is_file()
        self.tree: SemanticTree | None = SemanticTree.load(semantic_tree) if has_tree else None
        self.names: Mapping[int, str] = read_names(folder, semantic_tree).of_node if has_tree else {}
        self.cache = ViewStore(VIEWS_MIB)

    @property
    def of(self) -> str:
        """Source of the proposals at a pixel: "nodes", "masks", or "" if there are none."""
        return "nodes" if self.tree is not None else "masks" if (self.masks / "index.json").is_file() else ""

    def at(self, view: str, x: int, y: int) -> list[Proposal]:
        """Return the outlines of the nodes or masks that contain a pixel, the largest first.

        Raises:
            SettingsError: the pixel is outside the photograph.
        """
        height, width = self.scene.cameras[view].size_hw
        if not (0 <= x < width and 0 <= y < height):
            raise SettingsError(f"({x}, {y}) is not in the photograph", expected=f"x < {width}, y < {height}")
        if self.tree is not None:
            return self._nodes_at(view, y * width + x)
        return self._masks_at(view, x, y)

    def _nodes_at(self, view: str, pixel: int) -> list[Proposal]:
        assert self.tree is not None
        weights, size_hw = self._weights(view), self.scene.cameras[view].size_hw
        row = weights[pixel]
        regions = []
        for level in LEVELS:
            nodes = self.tree.node_of_gaussian[:, level.index]
            node, _ = heaviest_node(nodes[row.indices], row.data)
            if node != NONE:
                mask = weights @ (nodes == node).astype(np.float32) > 0.5
                regions.append((f"node {node}", self.names.get(node, ""), level, mask.reshape(size_hw)))
        return _proposals(regions)

    def _masks_at(self, view: str, x: int, y: int) -> list[Proposal]:
        path = self.masks / f"{view}.npz"  # test views have no masks
        if not path.is_file():
            return []
        masks, pixel = HierarchicalMasks.load(path), (x, y, x + 1, y + 1)
        order = np.argsort(-masks.area_px, kind="stable").tolist()
        rows = np.array([row for row in order if masks.window(row, pixel).any()][-MAX_MASKS:], np.int64)
        levels = map(Level, masks.level[rows].tolist())
        regions = zip(rows.tolist(), levels, masks.dense(rows), strict=True)
        return _proposals([(f"mask {row}", "", level, mask) for row, level, mask in regions])

    # -- from other views -------------------------------------------------------------------------

    def carried(
        self, known: Mapping[str, Sequence[Label]], ids: Sequence[int], view: str
    ) -> list[tuple[Label, list[list[tuple[int, int]]]]]:
        """Transfer objects annotated in other views to this view via Gaussians, parents before children.

        A Gaussian belongs to an object if more than half of its weight in the object's annotated views is
        inside the object's regions. Gaussians not visible there are ignored. Children are cut to parents.

        Args:
            known: annotations by view; unaccepted proposals are ignored.
            ids: ids of objects to transfer; objects with a label in this view are skipped.

        Returns:
            each object's label in another view, and its polygons in this view.

        Raises:
            SettingsError: the scene has no Gaussians yet.
        """
        if self.gaussians is None:
            raise SettingsError(
                "annotations cannot be transferred before the scene has Gaussians", fix="let the run finish"
            )
        size_hw = self.scene.cameras[view].size_hw
        masks = {label.id: label.mask(size_hw) for label in known.get(view, ())}
        labels_of: dict[int, dict[str, Label]] = {}
        for other, labels in known.items():
            for label in labels:
                if other != view and label.id in ids and label.origin != "proposed":
                    labels_of.setdefault(label.id, {})[other] = label
        weights, transferred = self._weights(view), []
        for annotated in sorted(labels_of.values(), key=lambda of_view: next(iter(of_view.values())).level):
            label = next(iter(annotated.values()))
            if label.id in masks or (label.parent is not None and label.parent not in masks):
                continue
            is_member, is_seen = self._members(annotated)
            part, seen = weights @ is_member, weights @ is_seen
            mask = ((part > 0.5 * seen) & (seen > MIN_SEEN)).reshape(size_hw)
            inside = True if label.parent is None else masks[label.parent]
            mask = cleaned(mask & inside) & inside
            if mask.any():
                masks[label.id] = mask
                transferred.append((label, traced(mask)))
        return transferred

    def _members(self, annotated: Mapping[str, Label]) -> tuple[np.ndarray, np.ndarray]:
        """Return, as 0 or 1, whether each Gaussian belongs to an object and whether its views show it."""
        assert self.gaussians is not None
        inside = np.zeros(len(self.gaussians), np.float64)
        total = np.zeros(len(self.gaussians), np.float64)
        for view, label in annotated.items():
            weights = self._weights(view)
            inside += weights.T @ label.mask(self.scene.cameras[view].size_hw).ravel().astype(np.float32)
            total += self.cache.get(("mass", view), partial(weights.sum, axis=0)).A1  # visible mass, px
        return (inside > 0.5 * total).astype(np.float32), (total > 0).astype(np.float32)

    def _weights(self, view: str) -> sp.csr_matrix:
        assert self.gaussians is not None
        min_weight = self.tree.min_weight if self.tree is not None else 0.0
        camera, threads = self.scene.cameras[view], self.threads
        draw = partial(pixel_weights, self.gaussians, camera, min_weight=min_weight, threads=threads)
        return self.cache.get(("weights", view), lambda: normalised_weights(draw()))


def _proposals(regions: Sequence[tuple[str, str, Level, np.ndarray]]) -> list[Proposal]:
    """Return the distinct proposals that are not empty after cleaning."""
    proposals: list[Proposal] = []
    for what, text, level, mask in regions:
        if (mask := cleaned(mask)).any():
            polygons = traced(mask)
            if all(polygons != other.polygons for other in proposals):
                proposals.append(Proposal(what, text, int(level), polygons))
    return proposals


def cleaned(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Remove specks and pinholes from a mask and smooth its outline; empty if only small pieces remain."""
    min_area_px = max(MIN_PX, MIN_SHARE * np.count_nonzero(mask))
    contours, ranks = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    canvas = np.zeros(mask.shape, np.uint8)
    if not contours:
        return canvas.astype(bool)
    by_area = sorted(zip(contours, ranks[0], strict=True), key=lambda pair: -cv2.contourArea(pair[0]))
    for contour, rank in by_area:  # from outside to inside, so that smaller pieces inside a hole are kept
        if cv2.contourArea(contour) >= min_area_px:
            cv2.fillPoly(canvas, [cv2.approxPolyDP(contour, SMOOTH_PX, True)], int(rank[3] < 0))
    return canvas.astype(bool)


# -- SAM -------------------------------------------------------------------------------------------


class Clicks:
    """The SAM model that computed a scene's masks, opened at the first click. Not thread-safe."""

    def __init__(self, scene: Scene, masks: Path) -> None:
        self.scene = scene
        index = read_index(masks) if (masks / "index.json").is_file() else {}
        self.folder: str = index.get("model") or "" if index.get("segmenter") == "sam" else ""
        self.encoded = lru_cache(CACHED_VIEWS)(lambda view: self.model.encode(scene.image(view)))

    @property
    def name(self) -> str:
        """Name of the model; empty if the scene's masks were computed without SAM."""
        return Path(self.folder).name

    @cached_property
    def model(self) -> SamModel:
        """The opened model; raises SettingsError if the scene's masks were computed without SAM."""
        if not self.folder:
            raise SettingsError(
                "this scene's masks were computed without SAM", fix="draw by hand, or compute masks with SAM"
            )
        return SamModel.load(Path(self.folder))

    def outlines(
        self, view: str, clicks: Sequence[tuple[int, int, bool]], box: tuple[int, int, int, int] | None
    ) -> list[Proposal]:
        """Return outlines of the object at clicks or in a box, best first.

        Masks are ranked by the number of clicks that they satisfy, then by SAM's predicted IoU (with a box,
        times the IoU of the mask's box and the given box).

        Args:
            clicks: x, y, and whether the pixel is inside the object.
            box: left, top, right, bottom, inclusive; used only without clicks.

        Raises:
            SettingsError: no click is on the object, one is outside the photograph, or there is no SAM.
        """
        height, width = self.scene.cameras[view].size_hw
        points = np.array([[x + 0.5, y + 0.5] for x, y, _ in clicks]).reshape(-1, 2)
        inside = np.array([is_inside for *_, is_inside in clicks], np.bool_)
        corners = np.array(box or (0, 0, 0, 0))
        if not (inside.any() or box) or (points < 0).any() or (points > (width, height)).any():
            raise SettingsError(
                "no click is on the object, or one is outside the photograph",
                expected=f"a click or box on the object, x < {width}, y < {height}",
            )
        encoded = self.encoded(view)
        sides = corners[2:] + 1 - corners[:2]
        prompts = points[inside] if clicks else corners[:2] + point_grid(BOX_GRID) * sides
        iou, logits = self.model.decode(encoded, prompts)
        iou, logits = iou.reshape(-1), logits.reshape(-1, *logits.shape[2:])
        if len(clicks) > 1:  # also decode all clicks as one prompt
            more_iou, more = self.model.decode_clicks(encoded, points, inside)
            iou, logits = np.concatenate([more_iou, iou]), np.concatenate([more, logits])
        masks = enlarged(logits, encoded.frame)
        columns, rows = points.astype(np.int64).T
        satisfied = (masks[:, rows, columns] == inside).sum(axis=1)
        fits = iou
        if box:
            bounds = np.array([cv2.boundingRect(mask.astype(np.uint8)) for mask in masks])
            boxes = np.concatenate([bounds[:, :2], bounds[:, :2] + bounds[:, 2:]], axis=1)
            fits = iou * box_iou(boxes, corners[None] + (0, 0, 1, 1))[:, 0]
        level_of: dict[int, Level] = {}  # the coarsest level among masks that count as the same
        for row in np.lexsort((-fits, -satisfied)).tolist():
            level = HEADS[row % len(HEADS)]
            same = [other for other in level_of if _iou(masks[row], masks[other]) >= SAME_IOU]
            for other in same:
                level_of[other] = min(level_of[other], level)
            if not same and len(level_of) < MAX_OUTLINES:
                level_of[row] = level
        return [
            Proposal(f"by {self.name}", "", int(level), traced(mask))
            for row, level in level_of.items()
            if (mask := cleaned(masks[row])).any()
        ]


def _iou(one: Bool[np.ndarray, "H W"], other: Bool[np.ndarray, "H W"]) -> float:
    union = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / union if union else 1.0
