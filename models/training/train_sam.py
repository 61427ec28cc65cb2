"""Train the small segmenter on labelled views."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from hilsplat.base.levels import LEVELS
from models.training.batches import CropStage, SamBatch, class_rows, draw_batch
from models.training.data import LabelledViews
from models.training.loop import Budget, Curve, Training, Tuning, has_fast_half
from models.training.measure_sam import measure_sam
from models.training.sam import SamDecoder, SamEncoder
from models.training.sam_loss import Teacher, training_loss

# Window sizes, drawn for each step in proportion to their shares: small windows cover more scenes, large ones
# more of each scene.
CROP_STAGES = (CropStage(0.4, 128, 16, 24), CropStage(0.4, 192, 8, 36), CropStage(0.2, 256, 4, 48))
# Window sizes later in the training, which include whole views as at run time. In the first training that
# ended with them, the IoU of wholes rose by 0.04 in 700 steps.
GROWN_STAGES = (CropStage(0.3, 192, 8, 36), CropStage(0.4, 256, 4, 48), CropStage(0.3, 384, 2, 96))
GROWN_AT = 9500  # first step with `GROWN_STAGES`, which are also used during the whole learning rate decay
TUNING = Tuning(peak=2e-3)
QUICK_VIEWS = 24  # number of held-out views measured for each row of the learning curve


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
