"""What the small models learn from: rendered views with labels, cut into crops, prompts and captions."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, Shaped, UInt8

from hilsplat.base.crops import square_crop
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.world.tiny.clip import CANONICAL, CROP_PX
from hilsplat.world.tiny.export import MEAN, STD
from hilsplat.world.tiny.sam import HEADS, UNIT_PX

HEAD_LEVELS = (Level.SUBPART, Level.PART, Level.WHOLE)
"""Level of each output head."""

FRAMES = ("{}", "{}", "{}", "the {}", "a {}", "a photo of a {}", "a photo of the {}", "a picture of a {}")
"""Sentence frames around a phrase; the bare phrase is the usual one."""

GENERIC_FRAMES = ("{}", "{}", "a photo of {}", "a photo of a {}", "the {}", "a {}")


@dataclass(frozen=True)
class LabelledNode:
    """A node of a training scene: its level, parent (-1: none) and the phrases that name it."""

    level: int
    parent: int
    phrases: tuple[str, ...]


@dataclass(frozen=True)
class LabelledViews:
    """V rendered views with exact labels.

    Attributes:
        images: the views.
        labels: per view and level (whole, part, subpart), node id per pixel, -1 for none.
        nodes: per view, the nodes of its scene, by id.
    """

    images: UInt8[np.ndarray, "V S S 3"]
    labels: np.ndarray
    nodes: tuple[tuple[LabelledNode, ...], ...]

    def __len__(self) -> int:
        return len(self.images)


def normalised(images: Shaped[np.ndarray, "B H W 3"]) -> Float32[np.ndarray, "B 3 H W"]:
    """Pixels in [0, 255] to what the networks take: channel first, mean and spread as configured."""
    scale = (1 / (255 * np.array(STD))).astype(np.float32)
    shift = (np.array(MEAN) / np.array(STD)).astype(np.float32)
    return np.ascontiguousarray((images * scale - shift).transpose(0, 3, 1, 2))


def recolour(
    rng: np.random.Generator, image: UInt8[np.ndarray, "H W 3"], strength: float = 1.0
) -> UInt8[np.ndarray, "H W 3"]:
    """Mild photographic differences: exposure, white balance, contrast, blur, coarser sampling, noise."""
    size = image.shape[:2]
    if rng.random() < 0.15 * strength:
        small = cv2.resize(image, (size[1] // 2, size[0] // 2), interpolation=cv2.INTER_AREA)
        image = cv2.resize(small, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    elif rng.random() < 0.25 * strength:
        image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.3, 1.0)))
    values = image.astype(np.float32)
    gain = rng.normal(1.0, 0.06 * strength) * rng.normal(1.0, 0.03 * strength, 3)
    middle = float(values.mean())
    contrast = rng.normal(1.0, 0.08 * strength)
    values = (values - middle) * contrast + middle
    values = values * gain.astype(np.float32)
    if rng.random() < 0.4 * strength:
        values += rng.normal(0, rng.uniform(1, 6), image.shape).astype(np.float32)
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class SegmentExample:
    """A training window: pixels, labels, where it lies in its view (x0, y0, side as shares)."""

    image: UInt8[np.ndarray, "S S 3"]
    labels: np.ndarray
    window: tuple[float, float, float]


def cut_window(
    rng: np.random.Generator,
    image: UInt8[np.ndarray, "H W 3"],
    labels: np.ndarray,
    size: int,
    zoom: bool = True,
) -> SegmentExample:
    """A random square of a view, possibly mirrored and enlarged or shrunk by up to a quarter.

    Args:
        rng: source of all choices.
        image: a square view.
        labels: (3, H, W) node ids.
        size: side of the window in network pixels; the whole view where it is at least the view's side.
        zoom: scale the window too.
    """
    full = image.shape[0]
    factor = float(np.exp(rng.uniform(-0.22, 0.25))) if zoom else 1.0
    side = min(full, max(16, round(size / factor)))
    x0, y0 = int(rng.integers(0, full - side + 1)), int(rng.integers(0, full - side + 1))
    image = image[y0 : y0 + side, x0 : x0 + side]
    labels = labels[:, y0 : y0 + side, x0 : x0 + side]
    if rng.random() < 0.5:
        image, labels, x0 = image[:, ::-1], labels[..., ::-1], full - side - x0
    if side != size:
        image = cv2.resize(np.ascontiguousarray(image), (size, size), interpolation=cv2.INTER_LINEAR)
        nearest = ((np.arange(size) + 0.5) * side / size).astype(np.int64)
        labels = labels[:, nearest][:, :, nearest]
    return SegmentExample(
        np.ascontiguousarray(image), np.ascontiguousarray(labels), (x0 / full, y0 / full, side / full)
    )


def nested_targets(labels: np.ndarray) -> np.ndarray:
    """Node id per pixel and head (subpart, part, whole).

    Where a pixel has no subpart, its subpart is its part; where it has no part, its part is its whole.

    Args:
        labels: (3, H, W) node ids, whole, part, subpart; -1 for none. Ids differ between levels.
    """
    whole, part, subpart = labels
    part = np.where(part >= 0, part, whole)
    return np.stack([np.where(subpart >= 0, subpart, part), part, whole])


def draw_prompts(
    rng: np.random.Generator, targets: np.ndarray, count: int, balanced: float = 0.6
) -> Int64[np.ndarray, "count 2"]:
    """Pixels (x, y) to prompt: a share of them balanced over regions, the rest uniform like a grid.

    Args:
        rng: source of all choices.
        targets: from `nested_targets`.
        count: number of prompts.
        balanced: share of prompts for which a region of the finest head is drawn first.
    """
    height, width = targets.shape[1:]
    flat = targets[0].reshape(-1)
    order = np.argsort(flat, kind="stable")
    ids, starts = np.unique(flat[order], return_index=True)
    ends = np.append(starts[1:], len(flat))
    known = np.flatnonzero(ids >= 0)
    pixels = rng.integers(0, height * width, count)
    if len(known):
        regions = rng.choice(known, count)
        inside = order[(starts[regions] + rng.random(count) * (ends - starts)[regions]).astype(np.int64)]
        pixels = np.where(rng.random(count) < balanced, inside, pixels)
    return np.stack([pixels % width, pixels // width], axis=1).astype(np.int64)


def region_centres(
    targets: np.ndarray, spacing_px: int = 1
) -> tuple[Float32[np.ndarray, "6 H W"], Bool[np.ndarray, "3 H W"]]:
    """Offset from each pixel to the mean position of its region, per head; where it is defined.

    Args:
        targets: from `nested_targets`, possibly at every n-th pixel only.
        spacing_px: that n.

    Returns:
        x and y of each head in turn, in units of 32 px, and a mask of pixels that have a region.
    """
    height, width = targets.shape[1:]
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) * spacing_px
    offsets = np.zeros((2 * len(HEADS), height, width), np.float32)
    for head, target in enumerate(targets):
        ids = target.reshape(-1) + 1
        counts = np.bincount(ids).clip(1)
        for axis, place in enumerate((x, y)):
            mean = np.bincount(ids, place.reshape(-1)) / counts
            offsets[2 * head + axis] = (mean[ids].reshape(height, width) - place) / UNIT_PX
    return offsets, targets >= 0


def roughen(rng: np.random.Generator, mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """A mask as a segmenter might have drawn it: grown, shrunk, rounded, shifted or with a bite taken out."""
    rough = mask.astype(np.float32)
    area = float(mask.sum())
    sigma = float(np.clip(0.05 * area**0.5 * rng.uniform(0.3, 2.0), 0.5, 6.0))
    noise = cv2.GaussianBlur(rng.normal(0, 1, mask.shape).astype(np.float32), (0, 0), 2 + sigma)
    noise /= noise.std() + 1e-6
    blurred = cv2.GaussianBlur(rough, (0, 0), sigma)
    found = blurred + 0.15 * noise * (blurred > 0.02) > rng.uniform(0.3, 0.6)
    if rng.random() < 0.25:
        rows, columns = np.nonzero(mask)
        pick = rng.integers(len(rows))
        radius = int(area**0.5 * rng.uniform(0.15, 0.4)) + 1
        bite = np.zeros(mask.shape, np.uint8)
        cv2.circle(bite, (int(columns[pick]), int(rows[pick])), radius, 1, -1)
        found &= ~bite.astype(bool)
    return found if found.any() else mask


@dataclass(frozen=True)
class CaptionedCrops:
    """N crops of masks and what may be said of each.

    Attributes:
        crops: what CLIP sees.
        captions: per crop, row of `phrase_sets`; -1 for a mask that shows nothing in particular.
        level: `Level` of the node that each crop shows.
        phrase_sets: the distinct sets of phrases.
        rough: whether the mask came from the small segmenter.
    """

    crops: UInt8[np.ndarray, "N 64 64 3"]
    captions: Int64[np.ndarray, " N"]
    level: np.ndarray
    phrase_sets: tuple[tuple[str, ...], ...]
    rough: Bool[np.ndarray, " N"]


@dataclass(frozen=True)
class RoughMask:
    """A mask that the small segmenter drew, with the level of the head that drew it."""

    mask: Bool[np.ndarray, "H W"]
    level: int


def best_node(
    mask: Bool[np.ndarray, "H W"], level: int, labels: np.ndarray, num_nodes: int
) -> tuple[int, float]:
    """Node whose region has the highest IoU with a mask, over all levels, and that IoU.

    Of equally good nodes the one of the given level wins: a part may be all that is seen of a whole.
    """
    best, best_iou = NONE, 0.0
    area = int(mask.sum())
    for candidate in LEVELS:
        image = labels[candidate.index]
        overlap = np.bincount(image[mask] + 1, minlength=num_nodes + 1)[1:]
        total = np.bincount(image.reshape(-1) + 1, minlength=num_nodes + 1)[1:]
        iou = overlap / np.maximum(total + area - overlap, 1)
        node = int(iou.argmax()) if len(iou) else NONE
        if node == NONE:
            continue
        better = iou[node] > best_iou + 1e-9
        equal = abs(iou[node] - best_iou) <= 1e-9 and int(candidate) == level
        if better or equal:
            best, best_iou = node, float(iou[node])
    return best, best_iou


def collect_crops(
    views: LabelledViews,
    rough: Sequence[Sequence[RoughMask]],
    seed: int,
    jitter: bool = True,
    min_area_px: int = 24,
    copies: dict[int, int] | None = None,
    backgrounds: Sequence[str] = ("black",),
) -> CaptionedCrops:
    """Cut crops of all nodes of all views, and of the segmenter's masks where it drew some.

    Args:
        views: rendered views.
        rough: masks of the segmenter per view, or an empty sequence. A mask shows the node with which
            its IoU is above 0.5; below 0.2 it shows nothing in particular; others are left out.
        seed: of the jitter.
        jitter: add a roughened copy of each exact mask.
        min_area_px: smaller regions are left out.
        copies: how many roughened copies a node of each level gets, 1 where not given; whole objects
            are rare among masks and want more.
        backgrounds: one is drawn per crop (see `square_crop`).
    """
    crops, captions, level, drawn = [], [], [], []
    sets: dict[tuple[str, ...], int] = {}
    copies = copies or {}
    for view in range(len(views)):
        rng = np.random.default_rng((seed, view))
        image, labels, nodes = views.images[view], views.labels[view], views.nodes[view]

        def add(
            mask: np.ndarray,
            node: int,
            is_rough: bool,
            rng: np.random.Generator = rng,
            image: np.ndarray = image,
            nodes: tuple[LabelledNode, ...] = nodes,
        ) -> None:
            background = backgrounds[int(rng.integers(len(backgrounds)))]
            crops.append(square_crop(image, mask, background, 0.0, CROP_PX))
            if node == NONE:
                captions.append(NONE)
                level.append(0)
            else:
                captions.append(sets.setdefault(nodes[node].phrases, len(sets)))
                level.append(nodes[node].level)
            drawn.append(is_rough)

        for at in LEVELS:
            ids, areas = np.unique(labels[at.index], return_counts=True)
            for node, area in zip(ids.tolist(), areas.tolist(), strict=True):
                if node < 0 or area < min_area_px or not nodes[node].phrases:
                    continue
                mask = labels[at.index] == node
                add(mask, node, False)
                for _ in range(copies.get(int(at), 1) if jitter else 0):
                    add(roughen(rng, mask), node, False)
        for found in rough[view] if rough else ():
            node, iou = best_node(found.mask, found.level, labels, len(nodes))
            if iou > 0.5 and nodes[node].phrases:
                add(found.mask, node, True)
            elif iou < 0.2:
                add(found.mask, NONE, True)
    return CaptionedCrops(
        np.stack(crops) if crops else np.zeros((0, CROP_PX, CROP_PX, 3), np.uint8),
        np.array(captions, np.int64),
        np.array(level, np.int64),
        tuple(sets),
        np.array(drawn, bool),
    )


class Captioner:
    """Draws a caption for each crop and says which captions are true of which crops.

    A small share of crops is described by one of the canonical phrases instead of their own. The
    draw does not look at the crop, so a canonical phrase comes to mean nothing in particular: the
    yardstick that relevancy needs.

    Args:
        phrase_sets: distinct sets of phrases.
        generic_share: share of crops that get a canonical phrase.
    """

    def __init__(self, phrase_sets: Sequence[tuple[str, ...]], generic_share: float = 0.06) -> None:
        self.phrases = sorted({phrase for phrases in phrase_sets for phrase in phrases})
        row = {phrase: index for index, phrase in enumerate(self.phrases)}
        self.choices = [np.array([row[phrase] for phrase in phrases]) for phrases in phrase_sets]
        self.truth = np.zeros((len(phrase_sets) + 1, len(self.phrases) + len(CANONICAL)), bool)
        for index, choice in enumerate(self.choices):
            self.truth[index, choice] = True
        self.generic_share = generic_share

    def draw(
        self, rng: np.random.Generator, captions: Int64[np.ndarray, " B"]
    ) -> tuple[list[str], Float32[np.ndarray, "B B"]]:
        """Texts for a batch of crops, and whether text j is true of crop i.

        Args:
            rng: source of all choices.
            captions: row of `phrase_sets` per crop, -1 for none (the crop then gets a canonical phrase).
        """
        texts, drawn = [], np.zeros(len(captions), np.int64)
        for index, caption in enumerate(captions.tolist()):
            if caption < 0 or rng.random() < self.generic_share:
                pick = int(rng.integers(len(CANONICAL)))
                drawn[index] = len(self.phrases) + pick
                phrase, frames = CANONICAL[pick], GENERIC_FRAMES
            else:
                choice = self.choices[caption]
                # The first phrase of a node is the text that queries use.
                pick = choice[0] if rng.random() < 0.5 else choice[int(rng.integers(len(choice)))]
                drawn[index] = pick
                phrase, frames = self.phrases[pick], FRAMES
            texts.append(frames[int(rng.integers(len(frames)))].format(phrase))
        generic = drawn >= len(self.phrases)
        valid = self.truth[captions][:, drawn] & ~generic[None, :]
        valid |= (drawn[:, None] == drawn[None, :]) & generic[None, :]
        np.fill_diagonal(valid, True)
        return texts, valid.astype(np.float32)
