"""Train the small segmenter on labelled views, measure it, and let it segment everything."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from hilsplat.base.levels import LEVELS, Level
from hilsplat.world.tiny.data import (
    HEAD_LEVELS,
    LabelledViews,
    RoughMask,
    cut_window,
    draw_prompts,
    nested_targets,
    normalised,
    recolour,
    region_centres,
)
from hilsplat.world.tiny.sam import (
    FINE,
    HEADS,
    MASK_STRIDE,
    OFFSETS,
    SEMANTIC,
    STRIDE,
    SamDecoder,
    SamEncoder,
    positional_embeddings,
)
from hilsplat.world.tiny.steps import Curve, learning_rate, prefetched

SEMANTIC_PIXELS = 4096
"""Pixels per batch that the auxiliary classifier is trained on."""


@dataclass(frozen=True)
class CropStage:
    """A stretch of the segmenter's training.

    Attributes:
        share: of all steps.
        crop_px: side of the windows.
        batch: windows per step.
        prompts: point prompts per window.
    """

    share: float
    crop_px: int
    batch: int
    prompts: int


# Small windows first: twice as many different ones in the same time; whole views last, as at run time.
CROP_STAGES = (CropStage(0.6, 128, 16, 14), CropStage(0.25, 192, 8, 16), CropStage(0.15, 256, 4, 24))


@dataclass(frozen=True)
class SamBatch:
    """Windows, prompts and targets of one step; P prompts per window."""

    pixels: Float[Tensor, "B 3 S S"]
    positional: Float[Tensor, "B D s s"]
    targets: Int64[Tensor, "B 3 S S"]
    classes: Int64[Tensor, "B 3 s s"]
    offsets: Float[Tensor, "B 6 s s"]
    has_region: Float[Tensor, "B 3 s s"]
    points: Float[Tensor, "B P N 2"]
    labels: Int64[Tensor, "B P N"]
    ids: Int64[Tensor, "B P 3"]


def class_rows(views: LabelledViews) -> tuple[dict[str, int], list[np.ndarray]]:
    """Number the texts of all nodes; per view, the class of each node id, with class 0 (none) at the end."""
    texts = sorted({node.phrases[0] for nodes in views.nodes for node in nodes})
    row = {text: index + 1 for index, text in enumerate(texts)}
    return row, [np.array([*(row[node.phrases[0]] for node in nodes), 0]) for nodes in views.nodes]


def draw_batch(
    views: LabelledViews, classes: Sequence[np.ndarray], stage: CropStage, rng: np.random.Generator
) -> SamBatch:
    """Windows with prompts; a sixth of the prompts has a second point, inside or outside."""
    images, windows, targets, kinds, offsets, regions, points, labels, ids = ([] for _ in range(9))
    centre = slice(STRIDE // 2, None, STRIDE)
    for view in rng.integers(0, len(views), stage.batch).tolist():
        example = cut_window(rng, views.images[view], views.labels[view], stage.crop_px)
        target = nested_targets(example.labels)
        offset, region = region_centres(target[:, centre, centre], STRIDE)
        place = draw_prompts(rng, target, stage.prompts)
        chosen = target[:, place[:, 1], place[:, 0]].T  # (P, 3)
        other = draw_prompts(rng, target, stage.prompts)
        same = target[:, other[:, 1], other[:, 0]].T
        second = np.where(same[:, 0] == chosen[:, 0], 1, np.where(same[:, 2] == chosen[:, 2], -1, 0))
        second = np.where(rng.random(stage.prompts) < 1 / 6, second, -1)
        images.append(recolour(rng, example.image))
        windows.append(example.window)
        targets.append(target)
        kinds.append(classes[view][target[:, centre, centre]])
        offsets.append(offset)
        regions.append(region)
        points.append(np.stack([place, other], axis=1) + 0.5)
        labels.append(np.stack([np.ones_like(second), second], axis=1))
        ids.append(chosen)
    cells = stage.crop_px // STRIDE
    return SamBatch(
        torch.from_numpy(normalised(np.stack(images))).contiguous(memory_format=torch.channels_last),
        positional_embeddings(torch.tensor(windows, dtype=torch.float32), cells),
        torch.from_numpy(np.stack(targets).astype(np.int64)),
        torch.from_numpy(np.stack(kinds).astype(np.int64)),
        torch.from_numpy(np.stack(offsets)),
        torch.from_numpy(np.stack(regions).astype(np.float32)),
        torch.from_numpy(np.stack(points).astype(np.float32)),
        torch.from_numpy(np.stack(labels).astype(np.int64)),
        torch.from_numpy(np.stack(ids).astype(np.int64)),
    )


def target_masks(
    targets: Int64[Tensor, "B 3 H W"], ids: Int64[Tensor, "B P 3"]
) -> Float[Tensor, "B P 3 h w"]:
    """True masks at stride 2: the share of each 2 x 2 block that belongs to the region."""
    wanted = ids[..., None, None].to(torch.int32)
    targets = targets[:, None].to(torch.int32)
    total = None
    for row in range(MASK_STRIDE):
        for column in range(MASK_STRIDE):
            hit = (targets[..., row::MASK_STRIDE, column::MASK_STRIDE] == wanted).to(torch.uint8)
            total = hit if total is None else total + hit
    return total.float() / MASK_STRIDE**2


def segmentation_loss(
    scores: Float[Tensor, "B P 3"],
    logits: Float[Tensor, "B P 3 h w"],
    truth: Float[Tensor, "B P 3 h w"],
    known: Float[Tensor, "B P 3"],
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Loss of masks (dice and cross-entropy per area) and of the predicted IoU.

    A prompt where nothing is labelled has no true mask: only its predicted IoU is trained, towards 0.
    """
    share = torch.sigmoid(logits).flatten(3)
    flat = truth.flatten(3)
    area = flat.sum(dim=-1)
    dice = 1 - (2 * (share * flat).sum(dim=-1) + 1) / (share.sum(dim=-1) + area + 1)
    entropy = functional.binary_cross_entropy_with_logits(logits.flatten(3), flat, reduction="none")
    # Per area of the region, so that a region of 50 px counts as much as the floor.
    entropy = entropy.sum(dim=-1) / (2 * area + 64)
    masks = ((dice + entropy) * known).sum() / known.sum().clamp(min=1.0)
    with torch.no_grad():
        found, wanted = logits.flatten(3) > 0, flat > 0.5
        overlap = (found & wanted).sum(dim=-1)
        iou = overlap / (found | wanted).sum(dim=-1).clamp(min=1)
    quality = (scores - iou * known).square().mean()
    return masks, quality


class SemanticHead(nn.Module):
    """Training only: which text names a pixel's region, at each head. It teaches the encoder to recognise."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.classify = nn.Linear(SEMANTIC, len(HEADS) * num_classes)

    def forward(
        self,
        embeddings: Float[Tensor, "B C s s"],
        classes: Int64[Tensor, "B 3 s s"],
        pixels: Int64[Tensor, " K"],
    ) -> Float[Tensor, ""]:
        """Mean cross-entropy at some pixels (rows of the flattened batch)."""
        features = embeddings[:, FINE * 4 + OFFSETS :].permute(0, 2, 3, 1).reshape(-1, SEMANTIC)[pixels]
        wanted = classes.permute(0, 2, 3, 1).reshape(-1, len(HEADS))[pixels]
        logits = self.classify(functional.relu(features)).reshape(-1, wanted.shape[1], self.num_classes)
        return functional.cross_entropy(logits.flatten(0, 1), wanted.flatten())

    @property
    def num_classes(self) -> int:
        """Number of texts, with "none"."""
        return self.classify.out_features // len(HEADS)


def stage_of_step(step: int, steps: int, stages: Sequence[CropStage]) -> CropStage:
    """The stage that a step belongs to."""
    done = 0.0
    for stage in stages:
        done += stage.share
        if step < done * steps:
            return stage
    return stages[-1]


def train_sam(
    views: LabelledViews,
    validation: LabelledViews,
    steps: int,
    seed: int,
    stages: Sequence[CropStage] = CROP_STAGES,
    peak: float = 2e-3,
    measure_every: int = 200,
) -> tuple[SamEncoder, SamDecoder, Curve]:
    """Train the segmenter.

    Args:
        views: rendered views with labels.
        validation: views of other scenes, for the learning curve.
        steps: optimisation steps.
        seed: of initial weights, windows and prompts.
        stages: sizes of windows and batches.
        peak: highest learning rate.
        measure_every: steps between rows of the learning curve.
    """
    torch.manual_seed(seed)
    encoder, decoder = SamEncoder(), SamDecoder()
    encoder.to(memory_format=torch.channels_last)
    rows, classes = class_rows(views)
    semantic = SemanticHead(len(rows) + 1)
    parameters = [*encoder.parameters(), *decoder.parameters(), *semantic.parameters()]
    optimiser = torch.optim.AdamW(parameters, lr=peak, weight_decay=0.02)
    curve, start, sums = Curve(), time.monotonic(), np.zeros(4)
    warmup = max(1, min(60, steps // 10))

    def make(step: int) -> SamBatch:
        rng = np.random.default_rng((seed, 1, step))
        return draw_batch(views, classes, stage_of_step(step, steps, stages), rng)

    for step, batch in enumerate(prefetched(make, steps)):
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(step, steps, peak, warmup)
        encoder.train()
        decoder.train()
        embeddings = encoder(batch.pixels)
        scores, logits = decoder(batch.points, batch.labels, embeddings, batch.positional)
        masks, quality = segmentation_loss(
            scores, logits, target_masks(batch.targets, batch.ids), (batch.ids >= 0).float()
        )
        generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
        count = batch.classes[:, 0].numel()
        pixels = torch.randint(0, count, (min(count, SEMANTIC_PIXELS),), generator=generator)
        recognised = semantic(embeddings, batch.classes, pixels)
        votes = embeddings[:, FINE * 4 : FINE * 4 + OFFSETS] - batch.offsets
        centred = (votes.abs() * batch.has_region.repeat_interleave(2, dim=1)).mean()
        loss = masks + quality + 0.5 * recognised + centred
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, 2.0)
        optimiser.step()
        sums += [value.item() for value in (masks, quality, recognised, centred)]
        if (step + 1) % measure_every == 0 or step + 1 == steps:
            since = (step % measure_every) + 1
            quick = LabelledViews(validation.images[:12], validation.labels[:12], validation.nodes[:12])
            found = measure_sam(encoder, decoder, quick, prompts=32, balanced=1.0)
            curve.add(
                step=step + 1,
                minutes=(time.monotonic() - start) / 60,
                mask_loss=sums[0] / since,
                iou_loss=sums[1] / since,
                semantic_loss=sums[2] / since,
                centre_loss=sums[3] / since,
                **{level.label: found[level.label]["iou"] for level in LEVELS},
            )
            sums[:] = 0
    return encoder.eval(), decoder.eval(), curve


@torch.no_grad()
def predict_masks(
    encoder: SamEncoder, decoder: SamDecoder, image: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Scores (P, 3) and mask logits (P, 3, 128, 128) for single points (P, 2) of one 256 px view."""
    encoder.eval()
    decoder.eval()
    embeddings = encoder(torch.from_numpy(normalised(image[None])))
    whole = positional_embeddings(torch.tensor([[0.0, 0.0, 1.0]]), image.shape[0] // STRIDE)
    prompts = torch.from_numpy(points.astype(np.float32))[None, :, None]
    labels = torch.ones(prompts.shape[:3], dtype=torch.int64)
    scores, logits = decoder(prompts, labels, embeddings, whole)
    return scores[0].numpy(), logits[0].numpy()


def measure_sam(
    encoder: SamEncoder,
    decoder: SamDecoder,
    views: LabelledViews,
    prompts: int,
    balanced: float,
    seed: int = 0,
) -> dict[str, dict[str, float]]:
    """Mean IoU with the true region of a prompt, per level, over prompts that have one there.

    Args:
        encoder: of the segmenter.
        decoder: of the segmenter.
        views: labelled views.
        prompts: per view.
        balanced: share of prompts balanced over the finest regions (1: all); the rest is uniform, as a grid.
        seed: of the prompts.

    Returns:
        per level: mean `iou`, share of prompts `above_75` %, `correlation` of predicted and true IoU, `n`.
    """
    found: dict[Level, list[tuple[float, float]]] = {level: [] for level in LEVELS}
    for view in range(len(views)):
        rng = np.random.default_rng((seed, 2, view))
        target = nested_targets(views.labels[view])
        points = draw_prompts(rng, target, prompts, balanced)
        scores, logits = predict_masks(encoder, decoder, views.images[view], points + 0.5)
        enlarged = functional.interpolate(
            torch.from_numpy(logits), scale_factor=float(MASK_STRIDE), mode="bilinear", align_corners=False
        ).numpy()
        for head, level in enumerate(HEAD_LEVELS):
            labels = views.labels[view][level.index]
            nodes = labels[points[:, 1], points[:, 0]]
            for row in np.flatnonzero(nodes >= 0):
                truth, guess = labels == nodes[row], enlarged[row, head] > 0
                iou = (truth & guess).sum() / (truth | guess).sum()
                found[level].append((float(iou), float(scores[row, head])))
    report = {}
    for level, pairs in found.items():
        values = np.array(pairs).reshape(-1, 2)
        spread = len(values) > 2 and values.std(axis=0).min() > 0
        report[level.label] = {
            "iou": float(values[:, 0].mean()) if len(values) else 0.0,
            "above_75": float((values[:, 0] > 0.75).mean()) if len(values) else 0.0,
            "correlation": float(np.corrcoef(values.T)[0, 1]) if spread else 0.0,
            "n": len(values),
        }
    return report


def segment_everything(
    encoder: SamEncoder,
    decoder: SamDecoder,
    image: np.ndarray,
    per_side: int = 16,
    iou_min: float = 0.35,
    stability_min: float = 0.5,
    nms_iou: float = 0.8,
) -> list[RoughMask]:
    """Masks of a grid of prompts, filtered as at run time and thinned within each level."""
    steps = (np.arange(per_side) + 0.5) * image.shape[0] / per_side
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    scores, logits = predict_masks(encoder, decoder, image, points)
    masks: list[RoughMask] = []
    for head, level in enumerate(HEAD_LEVELS):
        values = logits[:, head]
        area = (values > 0).sum(axis=(1, 2))
        stability = (values > 1).sum(axis=(1, 2)) / np.maximum((values > -1).sum(axis=(1, 2)), 1)
        keep = np.flatnonzero((scores[:, head] > iou_min) & (stability > stability_min) & (area > 4))
        keep = keep[np.argsort(-(scores[keep, head] * stability[keep]), kind="stable")]
        if not len(keep):
            continue
        small = (values[keep] > 0).reshape(len(keep), -1).astype(np.float32)
        overlap = small @ small.T
        size = small.sum(axis=1)
        iou = overlap / np.maximum(size[:, None] + size[None, :] - overlap, 1)
        chosen: list[int] = []
        for row in range(len(keep)):
            if not chosen or iou[row, chosen].max() <= nms_iou:
                chosen.append(row)
        enlarged = functional.interpolate(
            torch.from_numpy(values[keep[chosen]])[:, None], size=image.shape[:2], mode="bilinear"
        )[:, 0].numpy()
        masks += [RoughMask(mask, int(level)) for mask in enlarged > 0 if mask.any()]
    return masks
