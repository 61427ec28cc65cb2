"""Training batches for the segmenter: windows, prompts, and the pixels at which masks are compared."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, UInt8
from torch import Tensor

from models.training import data
from models.training.sam import HEADS, MASK_STRIDE, STRIDE, positional_embeddings

MARGIN = 4  # margin around a region's box that is sampled as densely as the box, mask px


@dataclass(frozen=True)
class CropStage:
    """Size and number of windows and prompts of a step."""

    share: float  # share of all steps
    crop_px: int  # side of the windows
    batch: int  # windows per step
    prompts: int  # point prompts per window
    pixels: int = 512  # mask pixels per prompt at which its masks are compared with the ground truth


@dataclass(frozen=True)
class SamBatch:
    """Windows, prompts and targets of one step; P prompts per window, K mask pixels per prompt."""

    pixels: Float[Tensor, "B 3 S S"]
    positional: Float[Tensor, "B D s s"]  # positional embeddings of the windows
    classes: Int64[Tensor, "B 3 s s"]  # row of the text that names each pixel's region, per head; 0 for none
    offsets: Float[Tensor, "B 6 s s"]  # from each pixel to its region's centre, see `region_centres`
    has_region: Float[Tensor, "B 3 s s"]
    edges: Float[Tensor, "B 3 h w"]  # 1 where a neighbour at stride 2 is in another region, per head
    points: Float[Tensor, "B P N 2"]  # x, y of the prompts, px
    labels: Int64[Tensor, "B P N"]  # of the points: 1 inside, 0 outside, -1 no point
    known: Float[Tensor, "B P 3"]  # 1 where a prompt has a ground-truth mask, per head
    places: Int64[Tensor, "B P K"]  # flat indices of mask pixels
    weights: Float[Tensor, "B P K"]  # number of mask pixels that each represents
    truth: Float[Tensor, "B P 3 K"]  # share of each of these mask pixels in the prompted region, per head

    def to(self, device: torch.device) -> "SamBatch":
        return SamBatch(**{field.name: getattr(self, field.name).to(device) for field in fields(self)})


def class_rows(views: data.LabelledViews) -> tuple[dict[str, int], list[np.ndarray]]:
    """Number all texts from 1; return also the class of each node id per view, with 0 (none) at the end."""
    texts = sorted({node.phrases[0] for nodes in views.nodes for node in nodes})
    row = {text: index + 1 for index, text in enumerate(texts)}
    return row, [np.array([*(row[node.phrases[0]] for node in nodes), 0]) for nodes in views.nodes]


def draw_level_prompts(
    rng: np.random.Generator, labels: np.ndarray, targets: np.ndarray, count: int, balanced: float = 0.8
) -> Int64[np.ndarray, "count 2"]:
    """Draw pixels (x, y) to prompt; for the share `balanced`, draw a level, then a region, then a pixel.

    The probability of a region is proportional to the fourth root of its area. Small regions are thus drawn
    too, but less often than the larger regions that a grid of prompts hits. The other prompts are uniform.

    `labels` contains (3, H, W) node ids, -1 for none. Levels that are missing in the window use `targets`,
    which are from `nested_targets`.
    """
    height, width = labels.shape[1:]
    pixels = rng.integers(0, height * width, count)
    choice = np.where(rng.random(count) < balanced, rng.integers(0, 3, count), -1)
    for level in range(3):
        rows = np.flatnonzero(choice == level)
        flat = labels[level].reshape(-1)
        if not (flat >= 0).any():
            flat = targets[0].reshape(-1)
        order = np.argsort(flat, kind="stable")
        ids, starts, areas = np.unique(flat[order], return_index=True, return_counts=True)
        present = np.flatnonzero(ids >= 0)
        if not len(present) or not len(rows):
            continue
        chance = areas[present] ** 0.25
        regions = rng.choice(present, len(rows), p=chance / chance.sum())
        pixels[rows] = order[(starts[regions] + rng.random(len(rows)) * areas[regions]).astype(np.int64)]
    return np.stack([pixels % width, pixels // width], axis=1).astype(np.int64)


def compared_pixels(
    rng: np.random.Generator, blocks: np.ndarray, chosen: Int64[np.ndarray, "P 3"], count: int
) -> tuple[Int64[np.ndarray, "P K"], Float32[np.ndarray, "P K"], Float32[np.ndarray, "P 3 K"]]:
    """Draw mask pixels per prompt: a quarter anywhere, a quarter in the box of each head's region.

    A mask of thousands of pixels is compared at a few hundred of them (as in PointRend and Mask2Former).
    Weighted sums over these pixels estimate sums over the whole mask.

    Args:
        blocks: (3, h, w, n) node ids of the n pixels under each mask pixel, per head.
        chosen: node per prompt and head, -1 for none.
        count: K.

    Returns:
        Flat indices, the number of mask pixels that each represents (about h w in total), and the share of
        each mask pixel that belongs to the region.
    """
    height, width = blocks.shape[1:3]
    whole = (0, 0, width, height)
    boxes = np.empty((len(chosen), 4, 4), np.int64)
    boxes[:, 0] = whole
    for head in range(len(HEADS)):
        region_boxes = data.boxes_of(blocks[head, :, :, 0])
        for row, node in enumerate(chosen[:, head].tolist()):
            x0, y0, x1, y1 = region_boxes.get(node, whole) if node >= 0 else whole
            boxes[row, head + 1] = (
                max(0, x0 - MARGIN), max(0, y0 - MARGIN), min(width, x1 + MARGIN), min(height, y1 + MARGIN)
            )  # fmt: skip
    drawn = boxes[:, np.arange(count) % 4]  # (P, K, 4)
    x = (drawn[..., 0] + rng.random(drawn.shape[:2]) * (drawn[..., 2] - drawn[..., 0])).astype(np.int64)
    y = (drawn[..., 1] + rng.random(drawn.shape[:2]) * (drawn[..., 3] - drawn[..., 1])).astype(np.int64)
    b = boxes[:, None]  # (P, 1, 4, 4)
    inside = (x[..., None] >= b[..., 0]) & (x[..., None] < b[..., 2])
    inside &= (y[..., None] >= b[..., 1]) & (y[..., None] < b[..., 3])
    area = (b[..., 2] - b[..., 0]) * (b[..., 3] - b[..., 1])
    density = (inside / (4.0 * area)).sum(axis=-1)
    truth = (blocks[:, y, x] == chosen.T[:, :, None, None]).mean(axis=-1)  # (3, P, K)
    return (
        y * width + x,
        (1 / (count * density)).astype(np.float32),
        truth.transpose(1, 0, 2).astype(np.float32),
    )


def region_edges(blocks: np.ndarray) -> Float32[np.ndarray, "heads h w"]:
    """Return a map per head that is 1 on both sides of each border between regions."""
    first = blocks[..., 0]
    edges = np.zeros(first.shape, np.float32)
    right = first[:, :, 1:] != first[:, :, :-1]
    below = first[:, 1:] != first[:, :-1]
    edges[:, :, 1:][right] = 1
    edges[:, :, :-1][right] = 1
    edges[:, 1:][below] = 1
    edges[:, :-1][below] = 1
    return edges


def _odd_colours(rng: np.random.Generator, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Occasionally permute or remove an image's colours, so that regions depend less on the world's hues."""
    draw = rng.random()
    if draw < 0.08:
        return np.ascontiguousarray(image[..., rng.permutation(3)])
    if draw < 0.12:
        return np.repeat(image.mean(axis=2, keepdims=True).astype(np.uint8), 3, axis=2)
    return image


def draw_batch(
    views: data.LabelledViews, classes: Sequence[np.ndarray], stage: CropStage, rng: np.random.Generator
) -> SamBatch:
    """Draw windows with prompts; up to a sixth of the prompts have a second point, inside or outside."""
    rows: list[tuple[np.ndarray, ...]] = []
    windows = []
    centre = slice(STRIDE // 2, None, STRIDE)
    side = stage.crop_px // MASK_STRIDE
    for view in rng.integers(0, len(views), stage.batch).tolist():
        image, labels, window = data.cut_window(rng, views.images[view], views.labels[view], stage.crop_px)
        target = data.nested_targets(labels)
        offset, region = data.region_centres(target[:, centre, centre], STRIDE)
        prompts = draw_level_prompts(rng, labels, target, stage.prompts)
        chosen = target[:, prompts[:, 1], prompts[:, 0]].T.astype(np.int64)  # (P, 3)
        other = draw_level_prompts(rng, labels, target, stage.prompts)
        same = target[:, other[:, 1], other[:, 0]].T
        second = np.where(same[:, 0] == chosen[:, 0], 1, np.where(same[:, 2] == chosen[:, 2], -1, 0))
        second = np.where(rng.random(stage.prompts) < 1 / 6, second, -1)
        blocks = target.reshape(3, side, MASK_STRIDE, side, MASK_STRIDE).transpose(0, 1, 3, 2, 4)
        blocks = np.ascontiguousarray(blocks).reshape(3, side, side, MASK_STRIDE**2)
        places, weights, truth = compared_pixels(rng, blocks, chosen, stage.pixels)
        windows.append(window)
        rows.append(
            (
                data.recolour(rng, _odd_colours(rng, image)),
                classes[view][target[:, centre, centre]].astype(np.int64),
                offset,
                region.astype(np.float32),
                region_edges(blocks),
                np.stack([prompts, other], axis=1).astype(np.float32) + np.float32(0.5),
                np.stack([np.ones_like(second), second], axis=1).astype(np.int64),
                (chosen >= 0).astype(np.float32),
                places,
                weights,
                truth,
            )
        )
    images, *others = (np.stack(column) for column in zip(*rows, strict=True))
    return SamBatch(
        torch.from_numpy(data.normalised(images)).contiguous(memory_format=torch.channels_last),
        positional_embeddings(torch.tensor(windows, dtype=torch.float32), stage.crop_px // STRIDE),
        *(torch.from_numpy(column) for column in others),
    )
