"""The diagnostic segmenter `truth-perturbed`: masks from a synthetic scene's ground truth, with faults.

It separates errors of the method from errors of the small segmenter. It is the only code before `evaluate`
that reads annotations, and it is never a default. The rule and the command pass the truth folder only if the
settings request it. The index records the faults, and every table row based on such masks has `SEGMENTER` in
its masks column.

Every decision about a fault uses a random number derived from a name (seed, scene, kind of fault, view,
node), so it depends neither on the order of views nor on other kinds of faults. A higher probability keeps
the faults of a lower probability and adds more of the same kind, so the steps of a sweep over a setting are
comparable.
"""

import logging
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int32
from scipy.sparse.csgraph import connected_components

from hilsplat.base.artifacts import read_index, read_json, write_index
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.lineage import require_size, sha256_of_json
from hilsplat.base.processes import in_order
from hilsplat.base.progress import stage_log, track
from hilsplat.datasets.hierarchy import AnnotatedNode, HierarchyAnnotations
from hilsplat.evaluate.metrics.masks import iou
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import index_entry
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.stage import train_views
from hilsplat_world.settings import PerturbSettings

logger = logging.getLogger(__name__)

SEGMENTER = "truth-perturbed"  # name of the segmenter, and label prefix of its masks

FAULTS = ("boundary_px", "merge", "split", "missing", "wrong_level", "systematic_merge", "systematic_missing")
"""Settings that change masks; if all are 0, the masks are exact."""

REACH = 3.0  # maximum displacement of a boundary, in standard deviations
WAVES = 48  # number of plane waves that are summed for a boundary's displacement
Borders = dict[int, Counter[int]]  # node -> adjacent sibling -> length of their common border, px


def run_truth_masks(
    scene_folder: Path, truth: Path, out: Path, settings: PerturbSettings, min_area_px: int, threads: int
) -> None:
    """Write each training view's masks from its ground-truth labels, with faults (see `faulty_masks`).

    The index also contains the requested faults and, per view, the number of faults. The result does not
    depend on `threads`.

    Raises:
        MisalignedArtifactError: if label images and cameras differ in size.
        ArtifactError: if the truth folder is missing or incomplete.
    """
    scene = Scene.load(scene_folder)
    views = train_views(scene)
    read_index(truth)
    annotations = HierarchyAnnotations.load(truth)
    background = read_json(Path(truth) / "scene.json")["background"]
    nodes = TrueNodes.of(
        annotations.nodes, background, (true_labels(annotations, view) for view in annotations.views)
    )
    draws = Draws(settings.seed, scene.name)
    label = faults_label(settings)
    with stage_log("masks", scene.name) as counts:
        logger.warning("%s: masks from ground truth (%s): for diagnosis, not for results", scene.name, label)

        def segment(view: str) -> tuple[HierarchicalMasks, dict[str, int]]:
            labels = true_labels(annotations, view)
            problem = f"the label image of view {view} does not match its camera"
            fix = "rerun poses without shrinking the images (poses.max_side_px)"
            require_size(problem, labels.shape[1:], scene.cameras[view].size_hw, fix)
            return faulty_masks(labels, nodes, view, draws, settings, min_area_px)

        index: dict[str, Any] = {}
        with atomic_folder(out) as folder:
            results = track(in_order(segment, views, threads), "masks of views", len(views))
            for view, (masks, faults) in zip(views, results, strict=True):
                masks.save(folder / f"{view}.npz")
                index[view] = {**index_entry(masks), "faults": faults}
            made_by = {"segmenter": SEGMENTER, "model": None, "model_sha256": None, "label": label}
            write_index(folder, index, scene=scene.name, **made_by, perturb=settings.model_dump(mode="json"))
        masks_per_level = {level.label: sum(row[level.label] for row in index.values()) for level in LEVELS}
        counts.update(views=len(views), **masks_per_level)


def true_labels(annotations: HierarchyAnnotations, view: str) -> Int32[np.ndarray, "3 H W"]:
    """Return the node id per level and pixel, -1 if there is no node."""
    return np.stack([annotations.label_image(view, level) for level in LEVELS])


def faults_label(settings: PerturbSettings) -> str:
    """Return the label of these masks in tables: the segmenter, then "exact" or the non-default settings.

    Example:
        >>> faults_label(PerturbSettings(merge=0.2))
        'truth-perturbed (merge 0.2)'
    """
    if not any(np.any(getattr(settings, fault)) for fault in FAULTS):
        return f"{SEGMENTER} (exact)"
    changed = []
    for name, value in settings.model_dump(exclude_defaults=True).items():
        text = "/".join(f"{share:g}" for share in value) if isinstance(value, tuple) else f"{value}"
        changed.append(f"{name} {text}")
    return f"{SEGMENTER} ({', '.join(changed)})" if changed else SEGMENTER


@dataclass(frozen=True)
class Draws:
    """Random numbers derived from names, independent of call order and number of threads."""

    seed: int
    scene: str

    def generator(self, *name: str | int) -> np.random.Generator:
        """Return a generator derived from a name."""
        digest = sha256_of_json([self.seed, self.scene, *name])
        return np.random.default_rng(int(digest[:32], 16))

    def chance(self, *name: str | int) -> float:
        """Return a number in [0, 1) derived from a name; events with probability p occur if it is below p."""
        return int(sha256_of_json([self.seed, self.scene, *name])[:13], 16) / 16**13


@dataclass(frozen=True)
class TrueNodes:
    """Scene-wide data that the faults depend on.

    A systematic merge joins a node and its partner, the sibling with which it shares the longest border over
    all views.
    """

    nodes: tuple[AnnotatedNode, ...]  # by id
    background: frozenset[int]  # ids of the surroundings, which are never merged
    partner: Mapping[int, int]  # of each node that has an adjacent sibling

    @staticmethod
    def of(
        nodes: tuple[AnnotatedNode, ...],
        background: Collection[int],
        labels: Iterable[Int32[np.ndarray, "3 H W"]],
    ) -> "TrueNodes":
        """Measure the borders in all views; `labels` contains one node-id image per view (-1: none)."""
        total: Borders = defaultdict(Counter)
        alone = TrueNodes(nodes, frozenset(background), {})
        for view in labels:
            for level in LEVELS:
                for node, around in sibling_borders(view[level.index], alone).items():
                    total[node].update(around)
        return replace(alone, partner={node: longest_border(total[node]) for node in sorted(total)})


def sibling_borders(labels: Int32[np.ndarray, "H W"], truth: TrueNodes) -> Borders:
    """Return the common borders of sibling nodes at one level, without the surroundings."""
    borders: Borders = defaultdict(Counter)
    for first, second in ((labels[:, :-1], labels[:, 1:]), (labels[:-1], labels[1:])):
        differ = (first != second) & (first != NONE) & (second != NONE)
        pairs = np.stack([first[differ], second[differ]], axis=1)
        for (a, b), length in zip(*np.unique(pairs, axis=0, return_counts=True), strict=True):
            a, b = int(a), int(b)
            siblings = truth.nodes[a].parent == truth.nodes[b].parent
            if siblings and not {a, b} & truth.background:
                borders[a][b] += int(length)
                borders[b][a] += int(length)
    return borders


def longest_border(around: Mapping[int, int]) -> int:
    """Return the neighbour with the longest border; the lower id wins ties."""
    return min(around, key=lambda other: (-around[other], other))


def merged_groups(
    ids: Sequence[int], borders: Borders, truth: TrueNodes, view: str, draws: Draws, settings: PerturbSettings
) -> list[tuple[int, ...]]:
    """Group the nodes of one level into the masks of a view; `ids` and each group are in ascending order.

    With probability `merge`, a node is merged with the sibling with which it shares the longest border in
    the view. A node selected for a systematic merge is merged with its `partner` in `systematic_share` of
    the views in which the two are adjacent.
    """
    if not ids:
        return []
    row = {node: number for number, node in enumerate(ids)}
    merged = np.zeros((len(ids), len(ids)), bool)
    for node in ids:
        around = {other: length for other, length in borders.get(node, {}).items() if other in row}
        if around and draws.chance("merge", view, node) < settings.merge:
            merged[row[node], row[longest_border(around)]] = True
        if truth.partner.get(node) in around and systematic("merge", node, view, draws, settings):
            merged[row[node], row[truth.partner[node]]] = True
    groups: dict[int, list[int]] = defaultdict(list)
    for node, group in zip(ids, connected_components(merged, directed=False)[1], strict=True):
        groups[group].append(node)
    return [tuple(group) for group in groups.values()]


def systematic(fault: str, node: int, view: str, draws: Draws, settings: PerturbSettings) -> bool:
    """Return whether a node's systematic fault ("merge" or "missing") occurs in a view."""
    probability = getattr(settings, f"systematic_{fault}")
    return (
        draws.chance(f"systematic {fault}", node) < probability
        and draws.chance(f"systematic {fault}", node, view) < settings.systematic_share
    )


def cut_in_two(
    mask: Bool[np.ndarray, "H W"], generator: np.random.Generator
) -> tuple[Bool[np.ndarray, "H W"], ...]:
    """Cut a mask along a line that leaves 30 to 70 % on each side; a mask too small to cut is unchanged."""
    angle, share = generator.uniform(0, np.pi), generator.uniform(0.3, 0.7)
    y, x = np.nonzero(mask)
    along = x * np.cos(angle) + y * np.sin(angle)
    near = along <= np.quantile(along, share)
    if near.all() or not near.any():
        return (mask,)
    first = np.zeros_like(mask)
    first[y[near], x[near]] = True
    return first, mask & ~first


def displaced(
    mask: Bool[np.ndarray, "H W"],
    amplitude_px: float | int,
    smooth_px: float | int,
    generator: np.random.Generator,
) -> Bool[np.ndarray, "H W"]:
    """Move a mask's boundary along its normal by a smooth random amount.

    A pixel is inside the new mask if its signed distance to the boundary (positive inside, 0.5 at the nearest
    pixel) exceeds `amplitude_px` times a random field of unit variance. The field is a sum of plane waves, so
    it depends only on the position: with the same generator, a larger amplitude changes all pixels that a
    smaller amplitude changes, and more.

    The boundary moves inwards by at most half the distance to the innermost pixel, so thin regions become
    thinner but do not vanish. Image borders are not boundaries.

    Args:
        mask: non-empty mask.
        amplitude_px: standard deviation of the displacement; 0 returns the mask itself.
        smooth_px: standard deviation of the field's Gaussian correlation function.
    """
    if amplitude_px == 0:
        return mask
    waves = generator.normal(0, 1 / smooth_px, (WAVES, 2))
    phases = generator.uniform(0, 2 * np.pi, WAVES)
    reach = REACH * amplitude_px
    margin = int(np.ceil(reach)) + 1
    ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    top, left = max(0, ys[0] - margin), max(0, xs[0] - margin)
    crop = np.s_[top : ys[-1] + 1 + margin, left : xs[-1] + 1 + margin]
    inside = mask[crop]
    if inside.all():
        return mask  # the mask fills the view
    distance = np.where(inside, _distance(inside) - 0.5, 0.5 - _distance(~inside))
    y, x = np.nonzero(np.abs(distance) < reach)
    field = np.cos((x + left)[:, None] * waves[:, 0] + (y + top)[:, None] * waves[:, 1] + phases).sum(axis=1)
    shift = np.clip(amplitude_px * np.sqrt(2 / WAVES) * field, -reach, min(reach, float(distance.max()) / 2))
    moved = inside.copy()
    moved[y, x] = distance[y, x] > shift
    result = mask.copy()
    result[crop] = moved
    return result


def _distance(inside: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return each inside pixel's distance to the nearest outside pixel (between centres, px); 0 outside."""
    return cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def beside(level: Level, up: bool) -> Level:
    """Return an adjacent level; for a part, `up` selects whole instead of subpart."""
    if level is not Level.PART:
        return Level.PART
    return Level.WHOLE if up else Level.SUBPART


def faulty_masks(
    labels: Int32[np.ndarray, "3 H W"],
    truth: TrueNodes,
    view: str,
    draws: Draws,
    settings: PerturbSettings,
    min_area_px: int,
) -> tuple[HierarchicalMasks, dict[str, int]]:
    """Return one view's true regions as masks, with faults applied in this order.

    1. Merges: a group of nodes becomes one mask (`merged_groups`).
    2. Missing masks: a group is dropped by its lowest node's random number or any node's systematic fault.
    3. Splits (`cut_in_two`), then boundaries (`displaced`). Each mask is changed separately, so masks may
       then overlap or leave gaps.
    4. Wrong levels: whole becomes part, subpart becomes part, part becomes either.

    `predicted_iou` is the mask's best IoU with the true region of one of its nodes, plus noise. `stability`
    is the mean of that IoU and 1, plus noise. Both scores are clipped to [0, 1]. A systematic merge thus
    lowers the scores as much as any other merge; a wrong level does not lower them. SAM's thresholds and
    suppressions are not applied: the masks are written exactly as specified.

    Args:
        labels: node id per level and pixel, -1 for none.
        min_area_px: minimum area of a true region that becomes a mask.

    Returns:
        The masks in `content_order`, and the number of faults of each kind.
    """
    counts = dict.fromkeys(("merged", "missing", "split", "wrong_level"), 0)
    rows: list[tuple[np.ndarray, Level, float, float]] = []
    for level in LEVELS:
        of_level = labels[level.index]
        areas = zip(*np.unique(of_level, return_counts=True), strict=True)
        ids = [int(node) for node, area_px in areas if node != NONE and area_px >= min_area_px]
        borders = sibling_borders(of_level, truth)
        for group in merged_groups(ids, borders, truth, view, draws, settings):
            lead = group[0]
            counts["merged"] += len(group) - 1
            if draws.chance("missing", view, lead) < settings.missing[level.index] or any(
                systematic("missing", node, view, draws, settings) for node in group
            ):
                counts["missing"] += 1
                continue
            pieces: tuple[np.ndarray, ...] = (np.isin(of_level, group),)
            if draws.chance("split", view, lead) < settings.split:
                pieces = cut_in_two(pieces[0], draws.generator("cut", view, lead))
                counts["split"] += len(pieces) - 1
            for number, piece in enumerate(pieces):
                name = (view, lead, number)
                mask, mask_level = piece, level
                if settings.boundary_px:
                    field = draws.generator("boundary", *name)
                    mask = displaced(piece, settings.boundary_px, settings.boundary_smooth_px, field)
                if draws.chance("wrong level", *name) < settings.wrong_level:
                    mask_level = beside(level, up=draws.chance("which level", *name) < 0.5)
                    counts["wrong_level"] += 1
                quality = max(iou(mask, of_level == node) for node in group)
                rows.append((mask, mask_level, *_scores(quality, draws, settings, name)))
    masks = HierarchicalMasks.from_dense(
        np.array([mask for mask, *_ in rows], bool).reshape(len(rows), *labels.shape[1:]),
        np.array([int(row[1]) for row in rows], np.uint8),
        np.array([row[2] for row in rows], np.float32),
        np.array([row[3] for row in rows], np.float32),
    )
    return masks.take(masks.content_order()), counts


def _scores(
    quality: float, draws: Draws, settings: PerturbSettings, name: tuple[str | int, ...]
) -> tuple[float, float]:
    """Return the predicted IoU and stability of a mask whose true IoU is `quality`."""
    noise = settings.score_noise * draws.generator("scores", *name).standard_normal(2)
    predicted, stability = np.clip(np.array([quality, (1 + quality) / 2]) + noise, 0, 1).tolist()
    return predicted, stability
