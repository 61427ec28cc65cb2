"""Training crops of the small CLIP, cut on demand from ground-truth, roughened and segmented masks."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from hilsplat.base.levels import LEVELS, NONE
from hilsplat.segment.crops import square_crop
from hilsplat.segment.masks import HierarchicalMasks
from models.training.clip import CANONICAL, CROP_PX
from models.training.data import LabelledViews, boxes_of

# Prompt templates around a phrase; the bare phrase has the highest weight.
FRAMES: tuple[str, ...] = (
    *("{}", "{}", "{}", "the {}", "a {}"),
    *("a photo of a {}", "a photo of the {}", "a picture of a {}"),
)
GENERIC_FRAMES: tuple[str, ...] = ("{}", "{}", "a photo of {}", "a photo of a {}", "the {}", "a {}")
MIN_PX = 24  # minimum area of a region
SHOWS = 0.5  # IoU above which a segmented mask is matched to a node
SHOWS_NOTHING = 0.2  # IoU below which a segmented mask is matched to no node


@dataclass(frozen=True)
class CropTable:
    """N masks in labelled views, with their captions."""

    views: LabelledViews
    masks: Sequence[HierarchicalMasks]  # segmented masks per view; empty if none were requested
    view: Int64[np.ndarray, " N"]
    node: Int64[np.ndarray, " N"]  # id of the node that the mask matches, -1 for none
    level: Int64[np.ndarray, " N"]  # `Level` of that node, 0 for none
    thing: Int64[np.ndarray, " N"]  # id of the node's object, unique within a view
    segmented: Int64[np.ndarray, " N"]  # row of the view's segmented masks, -1 for the ground-truth region
    box: Int64[np.ndarray, "N 4"]  # x0, y0, x1, y1 of the mask, end exclusive, px
    caption: Int64[np.ndarray, " N"]  # row of `phrase_sets`, -1 for none
    phrase_sets: tuple[tuple[str, ...], ...]  # distinct sets of phrases; the first of each is the query

    def __len__(self) -> int:
        return len(self.view)

    @property
    def rough(self) -> Bool[np.ndarray, " N"]:
        """Whether each mask is from the segmenter."""
        return self.segmented >= 0

    def cut(
        self, row: int, background: str = "black", rng: np.random.Generator | None = None
    ) -> UInt8[np.ndarray, "size size 3"]:
        """Return the CLIP crop of a mask; with `rng`, a ground-truth mask is roughened first."""
        x0, y0, x1, y1 = self.box[row].tolist()
        image = self.views.images[self.view[row]]
        margin = 2 + max(x1 - x0, y1 - y0) // 8 if rng is not None else 0
        x0, y0 = max(0, x0 - margin), max(0, y0 - margin)
        x1, y1 = min(image.shape[1], x1 + margin), min(image.shape[0], y1 + margin)
        if self.segmented[row] >= 0:
            masks = self.masks[self.view[row]]
            mask = masks.dense(np.array([self.segmented[row]]))[0, y0:y1, x0:x1]
        else:
            labels = self.views.labels[self.view[row], self.level[row] - 1, y0:y1, x0:x1]
            mask = labels == self.node[row]
        image = image[y0:y1, x0:x1]
        if rng is not None and self.segmented[row] < 0:
            image, mask = _shrunk(image, mask, 2 * CROP_PX)
            mask = roughen(rng, mask)
        return square_crop(image, mask, background, 0.0, CROP_PX)


def _shrunk(
    image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"], side: int
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Shrink both to at most `side` px, because roughening a large mask at full size is too slow."""
    scale = side / max(mask.shape)
    if scale >= 1:
        return image, mask
    size = (max(1, round(mask.shape[1] * scale)), max(1, round(mask.shape[0] * scale)))
    small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    if not small.any():
        return image, mask
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA), small


def roughen(rng: np.random.Generator, mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Imitate a segmenter's mask: grow or shrink it, round it, and remove or add a piece."""
    rough = mask.astype(np.float32)
    area = float(mask.sum())
    sigma = float(np.clip(0.06 * area**0.5 * rng.uniform(0.2, 2.0), 0.4, 6.0))
    noise = cv2.GaussianBlur(rng.normal(0, 1, mask.shape).astype(np.float32), (0, 0), 2 + sigma)
    noise = noise / (noise.std() + 1e-6)
    blurred = cv2.GaussianBlur(rough, (0, 0), sigma)
    result = blurred + rng.uniform(0.05, 0.3) * noise * (blurred > 0.02) > rng.uniform(0.25, 0.65)
    for chance, value in ((0.25, False), (0.2, True)):
        if rng.random() < chance:
            rows, columns = np.nonzero(mask)
            pick = rng.integers(len(rows))
            blob = np.zeros(mask.shape, np.uint8)
            radius = int(area**0.5 * rng.uniform(0.12, 0.35)) + 1
            cv2.circle(blob, (int(columns[pick]), int(rows[pick])), radius, 1, -1)
            result = np.where(blob > 0, value, result)
    # A mask that covers too little of its region is not a valid example.
    return result if (result & mask).sum() > 0.5 * (result | mask).sum() else mask


def best_node(
    mask: Bool[np.ndarray, "H W"], level: int, labels: np.ndarray, num_nodes: int
) -> tuple[int, float]:
    """Return the node of any level whose region has the highest IoU with a mask, and that IoU.

    Ties go to the node of the given level, because a whole and its only visible part have the same region.
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


def list_crops(views: LabelledViews, masks: Sequence[HierarchicalMasks] = ()) -> CropTable:
    """List all masks of labelled views: ground-truth regions, and segmented masks of the first views."""
    rows: list[tuple[int, ...]] = []
    boxes: list[Sequence[int]] = []
    sets: dict[tuple[str, ...], int] = {}
    for view in range(len(views)):
        labels, nodes = views.labels[view], views.nodes[view]
        root = list(range(len(nodes)))
        for node, described in enumerate(nodes):
            root[node] = root[described.parent] if described.parent >= 0 else node
        for at in LEVELS:
            areas = np.bincount(labels[at.index].reshape(-1) + 1, minlength=len(nodes) + 1)[1:]
            for node, box in boxes_of(labels[at.index]).items():
                if areas[node] >= MIN_PX and nodes[node].phrases:
                    caption = sets.setdefault(nodes[node].phrases, len(sets))
                    rows.append((view, node, nodes[node].level, root[node], -1, caption))
                    boxes.append(box)
        if view >= len(masks):
            continue
        segmented_masks = masks[view]
        for index in range(len(segmented_masks)):
            mask = segmented_masks.dense(np.array([index]))[0]
            node, iou = best_node(mask, int(segmented_masks.level[index]), labels, len(nodes))
            if iou > SHOWS and nodes[node].phrases:
                caption = sets.setdefault(nodes[node].phrases, len(sets))
                rows.append((view, node, nodes[node].level, root[node], index, caption))
            elif iou < SHOWS_NOTHING:
                rows.append((view, NONE, 0, NONE, index, NONE))
            else:
                continue
            boxes.append(segmented_masks.box_xyxy[index].tolist())
    columns = np.array(rows, np.int64).reshape(-1, 6).T
    of_view, of_node, levels, things, segmented, captions = map(np.ascontiguousarray, columns)
    box_xyxy = np.array(boxes, np.int64).reshape(-1, 4)
    return CropTable(
        views, masks, of_view, of_node, levels, things, segmented, box_xyxy, captions, tuple(sets)
    )


def list_segmented(views: LabelledViews, masks: Sequence[HierarchicalMasks]) -> CropTable:
    """List all segmented masks in order, without captions and regardless of their content."""
    view = np.repeat(np.arange(len(masks)), [len(of_view) for of_view in masks])
    none, level = np.full(len(view), NONE, np.int64), np.zeros(len(view), np.int64)
    # A first empty array, because NumPy cannot concatenate nothing.
    segmented = np.concatenate([none[:0], *(np.arange(len(of_view)) for of_view in masks)])
    box = np.concatenate([np.zeros((0, 4), np.int64), *(of_view.box_xyxy for of_view in masks)])
    return CropTable(views, masks, view, none, level, none, segmented, box, none, ())


class Captioner:
    """Generator of captions for crops, with the pairs of captions and crops that match.

    The share `generic_share` of crops gets a canonical phrase instead of its own. This choice is independent
    of the crop, so a canonical phrase has no specific meaning, as relevancy requires.

    Every query of the vocabulary and `others` further phrases are added to the captions of a batch as cheap
    additional positives and negatives.
    """

    def __init__(
        self, phrase_sets: Sequence[tuple[str, ...]], generic_share: float = 0.06, others: int = 512
    ) -> None:
        self.phrases = sorted({phrase for phrases in phrase_sets for phrase in phrases})
        row = {phrase: index for index, phrase in enumerate(self.phrases)}
        self.queries = np.array(sorted({row[phrases[0]] for phrases in phrase_sets}), np.int64)
        self.choices = [np.array([row[phrase] for phrase in phrases]) for phrases in phrase_sets]
        self.attributed = [
            np.array([row[phrase] for phrase in phrases if phrase.endswith(f" {phrases[0]}")], int)
            for phrases in phrase_sets
        ]
        self.generic_share = generic_share
        self.others = min(others, len(self.phrases))

    def draw(
        self, rng: np.random.Generator, captions: Int64[np.ndarray, " B"]
    ) -> tuple[list[str], Float32[np.ndarray, "B T"]]:
        """Draw texts for a batch of crops, text i for crop i; return also whether text j describes crop i.

        `captions` contains a row of `phrase_sets` per crop, -1 for none, which selects a canonical phrase.
        """
        texts, drawn = [], np.zeros(len(captions), np.int64)
        for index, caption in enumerate(captions.tolist()):
            if caption < 0 or rng.random() < self.generic_share:
                pick = int(rng.integers(len(CANONICAL)))
                drawn[index] = len(self.phrases) + pick
                phrase, frames = CANONICAL[pick], GENERIC_FRAMES
            else:
                choice, attributed, draw = self.choices[caption], self.attributed[caption], rng.random()
                # Queries mostly use a node's first phrase, and next most often a phrase such as "red kettle".
                if draw < 0.4:
                    pick = choice[0]
                elif draw < 0.6 and len(attributed):
                    pick = attributed[int(rng.integers(len(attributed)))]
                else:
                    pick = choice[int(rng.integers(len(choice)))]
                drawn[index] = pick
                phrase, frames = self.phrases[pick], FRAMES
            texts.append(frames[int(rng.integers(len(frames)))].format(phrase))
        beside = np.concatenate([self.queries, rng.choice(len(self.phrases), self.others, replace=False)])
        texts += [self.phrases[row] for row in beside]
        every = np.concatenate([drawn, beside])
        true = np.zeros((len(captions), len(self.phrases) + len(CANONICAL)), bool)
        for index, caption in enumerate(captions.tolist()):
            if caption >= 0:
                true[index, self.choices[caption]] = True
        generic = drawn >= len(self.phrases)
        true[generic, drawn[generic]] = True
        return texts, true[:, every].astype(np.float32)
