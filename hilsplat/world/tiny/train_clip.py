"""Train the small CLIP on captioned crops, and measure it."""

import time
from collections.abc import Sequence

import numpy as np
import torch
from tokenizers import Tokenizer
from torch import Tensor, nn

from hilsplat.base.levels import LEVELS
from hilsplat.world.tiny.clip import CANONICAL, ClipText, ClipVision, contrastive_loss, word_tokenizer
from hilsplat.world.tiny.data import FRAMES, GENERIC_FRAMES, CaptionedCrops, Captioner, normalised
from hilsplat.world.tiny.steps import Curve, learning_rate, prefetched


def tokenised(tokenizer: Tokenizer, texts: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Word ids and attention mask of texts."""
    encoded = tokenizer.encode_batch(list(texts))
    return (
        torch.tensor([row.ids for row in encoded], dtype=torch.int64),
        torch.tensor([row.attention_mask for row in encoded], dtype=torch.int64),
    )


def crop_weights(crops: CaptionedCrops, nothing: float = 0.03, rough: float = 0.4) -> np.ndarray:
    """Probability of each crop: levels equally often, the segmenter's masks for a share of each level."""
    weights = np.zeros(len(crops.crops))
    for level in (0, *map(int, LEVELS)):
        at_level = crops.level == level
        wanted = nothing if level == 0 else (1 - nothing) / len(LEVELS)
        for is_rough, share in ((True, rough), (False, 1 - rough)):
            group = at_level & (crops.rough == is_rough)
            other = at_level & (crops.rough != is_rough)
            if group.any():
                weights[group] = wanted * (share if other.any() else 1.0) / group.sum()
    return weights / weights.sum()


def train_clip(
    crops: CaptionedCrops,
    validation: CaptionedCrops,
    steps: int,
    seed: int,
    batch: int = 192,
    peak: float = 2e-3,
    measure_every: int = 100,
) -> tuple[ClipVision, ClipText, Tokenizer, Curve]:
    """Train the small CLIP.

    Args:
        crops: crops with their captions.
        validation: crops of other scenes, for the learning curve.
        steps: optimisation steps.
        seed: of initial weights, batches and captions.
        batch: crops per step.
        peak: highest learning rate.
        measure_every: steps between rows of the learning curve.
    """
    torch.manual_seed(seed)
    captioner = Captioner(crops.phrase_sets)
    frames = [frame.format("") for frame in (*FRAMES, *GENERIC_FRAMES)]
    tokenizer = word_tokenizer([*captioner.phrases, *CANONICAL, *frames])
    vision, text = ClipVision(), ClipText(tokenizer.get_vocab_size())
    vision.to(memory_format=torch.channels_last)
    scale = nn.Parameter(torch.tensor(np.log(10.0), dtype=torch.float32))
    matrices = [*vision.parameters(), *text.parameters()]
    optimiser = torch.optim.AdamW(
        [{"params": matrices, "weight_decay": 0.02}, {"params": [scale], "weight_decay": 0.0}], lr=peak
    )
    weights = crop_weights(crops)
    curve, start, total = Curve(), time.monotonic(), 0.0
    warmup = max(1, min(40, steps // 10))

    def make(step: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rng = np.random.default_rng((seed, 3, step))
        rows = rng.choice(len(weights), batch, p=weights)
        pixels = crops.crops[rows].astype(np.float32)
        gain = rng.normal(1.0, 0.06, (batch, 1, 1, 1)) * rng.normal(1.0, 0.03, (batch, 1, 1, 3))
        pixels *= gain.astype(np.float32)
        mirrored = rng.random(batch) < 0.5
        pixels[mirrored] = pixels[mirrored][:, :, ::-1]
        noisy = rng.random(batch) < 0.3
        seen = pixels.max(axis=3, keepdims=True) > 0  # the black background stays black
        noise = rng.normal(0, 4, pixels[noisy].shape).astype(np.float32)
        pixels[noisy] += noise * seen[noisy]
        texts, valid = captioner.draw(rng, crops.captions[rows])
        words, mask = tokenised(tokenizer, texts)
        forgotten = torch.from_numpy(rng.random(words.shape) < 0.02) & (mask == 1)
        words = torch.where(forgotten, torch.ones_like(words), words)
        images = torch.from_numpy(normalised(pixels.clip(0, 255)))
        return images.contiguous(memory_format=torch.channels_last), words, mask, torch.from_numpy(valid)

    for step, (pixels, words, mask, valid) in enumerate(prefetched(make, steps)):
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(step, steps, peak, warmup)
        vision.train()
        text.train()
        loss = contrastive_loss(vision(pixels), text(words, mask), valid, scale.exp().clamp(max=60.0))
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_([*matrices, scale], 2.0)
        optimiser.step()
        total += loss.item()
        if (step + 1) % measure_every == 0 or step + 1 == steps:
            found = measure_clip(vision, text, tokenizer, validation, [sets[0] for sets in crops.phrase_sets])
            curve.add(
                step=step + 1,
                minutes=(time.monotonic() - start) / 60,
                loss=total / ((step % measure_every) + 1),
                scale=scale.exp().item(),
                **{f"{kind}_{level}": value["top1"] for (kind, level), value in found.items()},
            )
            total = 0.0
    return vision.eval(), text.eval(), tokenizer, curve


@torch.no_grad()
def measure_clip(
    vision: ClipVision, text: ClipText, tokenizer: Tokenizer, crops: CaptionedCrops, texts: Sequence[str]
) -> dict[tuple[str, str], dict[str, float]]:
    """How often the best of all texts is the crop's own, per kind of mask and level.

    Args:
        vision: image side.
        text: text side.
        tokenizer: of the text side.
        crops: crops whose masks show a node.
        texts: queries that compete (all levels together); repeats are dropped.

    Returns:
        by ("exact" or "rough", level): `top1` and `top3` of all texts, `top1_of_level` among the texts of
        that level, share that beats every canonical phrase (`above_canonical`), `n`.
    """
    vision.eval()
    text.eval()
    texts = sorted(set(texts) | {phrases[0] for phrases in crops.phrase_sets})
    row = {phrase: index for index, phrase in enumerate(texts)}
    candidates = text(*tokenised(tokenizer, texts))
    canonical = text(*tokenised(tokenizer, CANONICAL))
    own = np.array([row[phrases[0]] for phrases in crops.phrase_sets], np.int64)
    shown = np.flatnonzero(crops.captions >= 0)
    vectors = torch.cat(
        [
            vision(torch.from_numpy(normalised(crops.crops[rows])))
            for rows in np.array_split(shown, len(shown) // 256 + 1)
        ]
    )
    similarity = (vectors @ candidates.T).numpy()
    yardstick = (vectors @ canonical.T).numpy().max(axis=1)
    wanted = own[crops.captions[shown]]
    level, rough = crops.level[shown], crops.rough[shown]
    mine = similarity[np.arange(len(shown)), wanted]
    rank = (similarity > mine[:, None]).sum(axis=1)
    report = {}
    for kind, is_rough in (("exact", False), ("rough", True)):
        for at in LEVELS:
            group = (level == int(at)) & (rough == is_rough)
            if not group.any():
                continue
            same = np.unique(wanted[level == int(at)])
            rank_of_level = (similarity[group][:, same] > mine[group, None]).sum(axis=1)
            report[(kind, at.label)] = {
                "top1": float((rank[group] == 0).mean()),
                "top3": float((rank[group] < 3).mean()),
                "top1_of_level": float((rank_of_level == 0).mean()),
                "above_canonical": float((mine[group] > yardstick[group]).mean()),
                "n": int(group.sum()),
            }
    return report
