"""Train the small CLIP on captioned crops."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from hilsplat.base.levels import LEVELS
from models.training.clip import CANONICAL, Clip, ClipText, ClipVision, contrastive_loss, word_tokenizer
from models.training.crops import FRAMES, GENERIC_FRAMES, Captioner, CropTable
from models.training.data import normalised
from models.training.loop import Budget, Curve, Training, Tuning, has_fast_half
from models.training.measure_clip import measure_clip, tokenised

TUNING = Tuning(peak=2e-3, warmup=60, measure_every=200)
BATCH = 192  # crops per step
THING_SHARE = 0.5  # share of a batch drawn in groups from one object, whose other parts are hard negatives
SIBLINGS = 6  # maximum number of crops in such a group
KEPT_SHARE = 0.2  # share of crops whose surroundings are kept, so that `clip.background: keep` works too
QUICK_CROPS = 3000  # approximate number of crops measured for each row of the learning curve


def crop_weights(crops: CropTable, nothing: float = 0.03, rough: float = 0.45) -> np.ndarray:
    """Return the probability of each crop: equal for all levels, with a share for the segmenter's masks."""
    weights = np.zeros(len(crops))
    for level in (0, *map(int, LEVELS)):
        at_level = crops.level == level
        level_share = nothing if level == 0 else (1 - nothing) / len(LEVELS)
        for is_rough, share in ((True, rough), (False, 1 - rough)):
            group = at_level & (crops.rough == is_rough)
            other = at_level & (crops.rough != is_rough)
            if group.any():
                weights[group] = level_share * (share if other.any() else 1.0) / group.sum()
    return weights / weights.sum()


class CropDraw:
    """Generator of batches of rows, drawn partly one by one and partly in groups from one object."""

    def __init__(self, crops: CropTable, batch: int) -> None:
        self.ends = np.cumsum(crop_weights(crops))
        self.batch = batch
        # In this order, rows of the same object in the same view are adjacent.
        key = crops.view * (int(crops.thing.max(initial=0)) + 2) + crops.thing + 1
        self.order = np.argsort(key, kind="stable")
        self.first = np.searchsorted(key[self.order], key, side="left")
        self.last = np.searchsorted(key[self.order], key, side="right")

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        seeds = np.searchsorted(self.ends, rng.random(self.batch) * self.ends[-1], side="right")
        seeds = np.minimum(seeds, len(self.ends) - 1)
        rows = list(seeds[: round(self.batch * (1 - THING_SHARE))])
        for seed in seeds[len(rows) :]:
            room = min(SIBLINGS, self.batch - len(rows))
            if room <= 0:
                break
            same = self.order[self.first[seed] : self.last[seed]]
            rows += list(rng.permutation(same)[:room])
        return np.array(rows[: self.batch])


def jittered(rng: np.random.Generator, pixels: np.ndarray) -> np.ndarray:
    """Vary light, mirroring, noise and blur of crops at random; noise leaves a black background black."""
    count = len(pixels)
    pixels = pixels.astype(np.float32)
    seen = pixels.max(axis=3, keepdims=True) > 0
    gain = rng.normal(1.0, 0.07, (count, 1, 1, 1)) * rng.normal(1.0, 0.03, (count, 1, 1, 3))
    pixels *= gain.astype(np.float32)
    mirrored = rng.random(count) < 0.5
    pixels[mirrored] = pixels[mirrored][:, :, ::-1]
    seen[mirrored] = seen[mirrored][:, :, ::-1]
    noisy = rng.random(count) < 0.3
    noise = rng.normal(0, 4, pixels[noisy].shape).astype(np.float32)
    pixels[noisy] += noise * seen[noisy]
    blurred = rng.random(count) < 0.2
    soft = pixels[blurred]
    soft[:, 1:-1] = (soft[:, :-2] + 2 * soft[:, 1:-1] + soft[:, 2:]) / 4
    soft[:, :, 1:-1] = (soft[:, :, :-2] + 2 * soft[:, :, 1:-1] + soft[:, :, 2:]) / 4
    pixels[blurred] = soft
    return pixels.clip(0, 255)


def train_clip(
    crops: CropTable,
    validation: CropTable,  # masks of other scenes, for the learning curve
    budget: Budget,
    seed: int,  # of initial weights, batches and captions
    state: Path,  # folder of the training's state
    name: str = "clip",  # base name of the state's files
    batch: int = BATCH,
    tuning: Tuning = TUNING,
    device: str = "cpu",  # or "cuda"
) -> tuple[Clip, Curve]:
    """Train the small CLIP, or resume a training with the same name."""
    torch.manual_seed(seed)
    where = torch.device(device)
    half = has_fast_half(where)
    captioner = Captioner(crops.phrase_sets)
    frames = [frame.format("") for frame in (*FRAMES, *GENERIC_FRAMES)]
    tokenizer = word_tokenizer([*captioner.phrases, *CANONICAL, *frames])
    vision, text = ClipVision(), ClipText(tokenizer.get_vocab_size())
    nn.utils.convert_conv2d_weight_memory_format(vision, torch.channels_last)
    scale = nn.ParameterDict({"logarithm": torch.tensor(np.log(10.0), dtype=torch.float32)})  # of the cosines
    training = Training({"vision": vision, "text": text, "scale": scale}, tuning, state, name, where)
    drawer = CropDraw(crops, batch)
    quick = np.arange(0, len(validation), max(1, len(validation) // QUICK_CROPS))

    def make(step: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rng = np.random.default_rng((seed, 3, step))
        rows = drawer.draw(rng)
        cut = []
        for row in rows.tolist():
            background = "keep" if rng.random() < KEPT_SHARE else "black"
            cut.append(crops.cut(row, background, rng if rng.random() < 0.6 else None))
        texts, valid = captioner.draw(rng, crops.caption[rows])
        words, mask = tokenised(tokenizer, texts)
        forgotten = torch.from_numpy(rng.random(words.shape) < 0.02) & (mask == 1)
        words = torch.where(forgotten, torch.ones_like(words), words)
        images = torch.from_numpy(normalised(jittered(rng, np.stack(cut))))
        return images.contiguous(memory_format=torch.channels_last), words, mask, torch.from_numpy(valid)

    def loss_of(parts: tuple[Tensor, ...], step: int) -> tuple[Tensor, dict[str, float]]:
        pixels, words, mask, valid = (part.to(where) for part in parts)
        with torch.autocast(where.type, torch.bfloat16, enabled=half):
            features = vision.layers(pixels)
        image = vision.projected(features.float())
        loss = contrastive_loss(image, text(words, mask), valid, scale["logarithm"].exp().clamp(max=60.0))
        return loss, {"contrastive": loss.item()}

    def measure() -> dict[str, float]:
        accuracies = measure_clip(Clip(vision, text, tokenizer), validation, quick)
        return {f"{kind}_{level}": value["top1"] for (kind, level), value in accuracies.items()}

    curve = training.run(make, loss_of, measure, budget)
    return Clip(vision.cpu().eval(), text.cpu().eval(), tokenizer), curve
