"""Training of the small segmenter on labelled views, and the losses of its outputs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from hilsplat.base.levels import LEVELS
from models.training.batches import CropStage, SamBatch, class_rows, draw_batch
from models.training.data import LabelledViews
from models.training.loop import Budget, Curve, Training, Tuning, has_fast_half
from models.training.measure_sam import measure_sam
from models.training.sam import HEADS, SEMANTIC, STRIDE, SamDecoder, SamEncoder

# Window sizes, drawn for each step in proportion to their shares: small windows cover more scenes, large ones
# more of each scene.
CROP_STAGES = (CropStage(0.4, 128, 16, 24), CropStage(0.4, 192, 8, 36), CropStage(0.2, 256, 4, 48))
# Window sizes later in the training, which include whole views as at run time. In the first training that
# ended with them, the IoU of wholes rose by 0.04 in 700 steps.
GROWN_STAGES = (CropStage(0.3, 192, 8, 36), CropStage(0.4, 256, 4, 48), CropStage(0.3, 384, 2, 96))
GROWN_AT = 9500  # first step with `GROWN_STAGES`, which are also used during the whole learning rate decay
TUNING = Tuning(peak=2e-3)
QUICK_VIEWS = 24  # number of held-out views measured for each row of the learning curve
SEMANTIC_PIXELS = 1536  # random pixels per batch for the auxiliary classifier, besides the prompted ones


def segmentation_loss(
    scores: Float[Tensor, "B P 3"],  # predicted IoU
    logits: Float[Tensor, "B P 3 K"],  # logits at K pixels of each mask
    truth: Float[Tensor, "B P 3 K"],  # share of each of these pixels in the prompted region
    weights: Float[Tensor, "B P K"],  # number of mask pixels that each represents
    known: Float[Tensor, "B P 3"],  # 1 where there is a ground-truth mask
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return the losses of the masks (dice and cross-entropy per area) and of the predicted IoU.

    A prompt on an unlabelled pixel has no ground-truth mask, so only its predicted IoU is trained, towards 0.
    """
    weights = weights[:, :, None]
    share = torch.sigmoid(logits)
    area = (weights * truth).sum(dim=-1)
    dice = 1 - (2 * (weights * share * truth).sum(dim=-1) + 1) / ((weights * share).sum(dim=-1) + area + 1)
    entropy = functional.binary_cross_entropy_with_logits(logits, truth, reduction="none")
    # Cross-entropy is divided by the region's area, so that 50 px count as much as the floor.
    entropy = (weights * entropy).sum(dim=-1) / (2 * area + 64)
    masks = ((dice + entropy) * known).sum() / known.sum().clamp(min=1.0)
    with torch.no_grad():
        predicted, target = (logits > 0) * weights, truth > 0.5
        overlap = (predicted * target).sum(dim=-1)
        union = (predicted + target * weights).sum(dim=-1) - overlap
        iou = overlap / union.clamp(min=1e-6)
    quality = (scores - iou * known).square().mean()
    return masks, quality


class Teacher(nn.Module):
    """Auxiliary outputs for training: the text class of a pixel's region, and region borders, per head."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.classify = nn.Linear(SEMANTIC, len(HEADS) * num_classes)
        self.edge = nn.Conv2d(32, len(HEADS), 1)

    def recognised(
        self, semantic: Float[Tensor, "B C s s"], batch: SamBatch, generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Return the cross-entropy at prompted pixels, which balance region sizes, and at random pixels."""
        rows, _, height, width = semantic.shape
        cell = (batch.points[:, :, 0] / STRIDE).long().clamp(0, width - 1)
        first = torch.arange(rows, device=cell.device)[:, None] * height * width
        prompted = (first + cell[..., 1] * width + cell[..., 0]).flatten()
        count = rows * height * width
        others = torch.randint(0, count, (min(count, SEMANTIC_PIXELS),), generator=generator)
        pixels = torch.cat([prompted, others.to(prompted.device)])
        features = semantic.permute(0, 2, 3, 1).flatten(0, 2).index_select(0, pixels)
        target = batch.classes.permute(0, 2, 3, 1).flatten(0, 2).index_select(0, pixels)
        logits = self.classify(features).unflatten(-1, (len(HEADS), -1))
        return functional.cross_entropy(logits.flatten(0, 1), target.flatten())

    def bordered(self, sharp: Float[Tensor, "B C h w"], batch: SamBatch) -> Float[Tensor, ""]:
        """Return the cross-entropy of the border maps, in which borders have fourfold weight."""
        logits = self.edge(sharp).float()
        entropy = functional.binary_cross_entropy_with_logits(logits, batch.edges, reduction="none")
        return (entropy * (1 + 3 * batch.edges)).mean()


def training_loss(
    encoder: SamEncoder,
    decoder: SamDecoder,
    teacher: Teacher,
    batch: SamBatch,
    generator: torch.Generator,
    half: bool,
) -> tuple[Float[Tensor, ""], dict[str, float]]:
    """Return the total loss of one step and its terms; `half`: run the encoder's convolutions in bfloat16."""
    with torch.autocast(batch.pixels.device.type, torch.bfloat16, enabled=half):
        packed, offsets, semantic, sharp = encoder.features(batch.pixels)
    packed, offsets, semantic = packed.float(), offsets.float(), semantic.float()
    embeddings = torch.cat([packed, offsets, semantic], dim=1)
    scores, logits = decoder.at_pixels(
        batch.points, batch.labels, embeddings, batch.positional, batch.places, batch.weights
    )
    masks, quality = segmentation_loss(scores, logits, batch.truth, batch.weights, batch.known)
    recognised = teacher.recognised(semantic, batch, generator)
    bordered = teacher.bordered(sharp.float(), batch)
    votes = offsets - batch.offsets
    centred = (votes.abs() * batch.has_region.repeat_interleave(2, dim=1)).mean()
    terms = {"mask": masks, "iou": quality, "semantic": recognised, "edge": bordered, "centre": centred}
    loss = masks + quality + 0.5 * recognised + bordered + centred
    return loss, {name: value.item() for name, value in terms.items()}


def train_sam(
    views: LabelledViews,
    validation: LabelledViews,  # views of other scenes, for the learning curve
    budget: Budget,
    seed: int,  # of initial weights, windows and prompts
    state: Path,  # folder of the training's state
    name: str = "sam",  # base name of the state's files
    stages: Sequence[CropStage] = CROP_STAGES,
    grown_stages: Sequence[CropStage] = GROWN_STAGES,  # from step `GROWN_AT` on, and during the decay
    tuning: Tuning = TUNING,
    device: str = "cpu",  # or "cuda"
) -> tuple[SamEncoder, SamDecoder, Curve]:
    """Train the small segmenter, or resume a training with the same name."""
    torch.manual_seed(seed)
    where = torch.device(device)
    half = has_fast_half(where)
    rows, classes = class_rows(views)
    encoder = nn.utils.convert_conv2d_weight_memory_format(SamEncoder(), torch.channels_last)
    decoder, teacher = SamDecoder(), Teacher(len(rows) + 1)
    modules = {"encoder": encoder, "decoder": decoder, "teacher": teacher}
    training = Training(modules, tuning, state, name, where)
    quick = validation.spread(QUICK_VIEWS)

    def make(step: int) -> SamBatch:
        rng = np.random.default_rng((seed, 1, step))
        # The first batch of the decay is prefetched before the decay begins, so it is excluded.
        falling = 0 <= training.progress.decay_from < step
        windows = grown_stages if falling or step >= GROWN_AT else stages
        ends = np.cumsum([stage.share for stage in windows])
        drawn = min(len(windows) - 1, int(np.searchsorted(ends, rng.random(), side="right")))
        return draw_batch(views, classes, windows[drawn], rng)

    def loss_of(batch: SamBatch, step: int) -> tuple[Tensor, dict[str, float]]:
        generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
        return training_loss(encoder, decoder, teacher, batch.to(where), generator, half)

    def measure() -> dict[str, float]:
        quality = measure_sam(encoder, decoder, quick)
        return {level.label: quality[level.label]["iou"] for level in LEVELS}

    curve = training.run(make, loss_of, measure, budget)
    return encoder.cpu().eval(), decoder.cpu().eval(), curve
