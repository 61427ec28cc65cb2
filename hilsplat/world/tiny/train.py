"""The recipe of the embedded small models: render, train, measure, export, describe."""

import logging
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import load_file, save_file
from torch import nn

from hilsplat.base.artifacts import atomic_folder, atomic_path, read_json, sha256_of_json, write_json
from hilsplat.base.progress import stage_log, track
from hilsplat.world.tiny.card import write_clip_card, write_sam_card
from hilsplat.world.tiny.data import LabelledViews, RoughMask, collect_crops
from hilsplat.world.tiny.export import export_clip, export_sam
from hilsplat.world.tiny.render import generator_digest, render_training_views, training_seeds
from hilsplat.world.tiny.sam import SamDecoder, SamEncoder
from hilsplat.world.tiny.steps import Curve
from hilsplat.world.tiny.train_clip import measure_clip, train_clip
from hilsplat.world.tiny.train_sam import measure_sam, segment_everything, train_sam

logger = logging.getLogger(__name__)

RECIPE_VERSION = 1
"""Raise it when networks, windows or losses change: a segmenter in the cache is then trained again."""
ROUGH_VIEWS = 160
"""Training views that the finished segmenter segments, so that CLIP meets masks as it draws them."""
ROUGH_PROMPTS = 14
"""Prompts per image side there; half as many as at run time give masks enough."""
COPIES = {1: 4, 2: 1, 3: 1}
"""Roughened copies of each exact mask, per level: whole objects are rare among masks."""


@dataclass(frozen=True)
class Recipe:
    """Everything the small models follow from, except the number format of the machine.

    Attributes:
        scenes: training scenes.
        views: views of each.
        validation_scenes: further training-range scenes, for curves and metrics only.
        sam_steps: optimisation steps of the segmenter.
        clip_steps: optimisation steps of CLIP.
        seed: of weights, windows, prompts, jitter and captions.
    """

    scenes: int
    views: int
    validation_scenes: int
    sam_steps: int
    clip_steps: int
    seed: int


def train_models(
    out: Path,
    cache: Path,
    sam_steps: int = 1700,
    clip_steps: int = 1500,
    seed: int = 0,
    threads: int = 2,
    scenes: int = 400,
    validation_scenes: int = 24,
    views: int = 2,
) -> None:
    """Train the small SAM and CLIP on training scenes of the synthetic world, and write both model folders.

    The recipe counts steps, not minutes, so it repeats itself on one machine with the same number of
    threads; other machines differ in the last digits of sums, and so in the trained weights.

    Args:
        out: folder that will hold `sam-tiny` and `clip-tiny`.
        cache: rendered views and the trained segmenter; a killed run goes on from there.
        sam_steps: optimisation steps of the segmenter.
        clip_steps: optimisation steps of CLIP.
        seed: of everything random but the scenes.
        threads: of torch; also the number of rendering processes.
        scenes: training scenes.
        validation_scenes: further scenes, on which nothing is trained.
        views: per scene.
    """
    recipe = Recipe(scenes, views, validation_scenes, sam_steps, clip_steps, seed)
    out, cache = Path(out), Path(cache)
    train_seeds, other_seeds = training_seeds(scenes, validation_scenes)
    threads_before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with stage_log("train", "sam-tiny") as counts:
            training = render_training_views(cache, train_seeds, views, threads)
            unseen = render_training_views(cache, other_seeds, views, threads)
            encoder, decoder, curve = _trained_sam(training, unseen, recipe, cache, threads)
            metrics = {
                "balanced": measure_sam(encoder, decoder, unseen, 32, balanced=1.0),
                "grid": measure_sam(encoder, decoder, unseen, 32, balanced=0.0),
            }
            counts.update({level: f"{value['iou']:.3f}" for level, value in metrics["balanced"].items()})
            with atomic_folder(out / "sam-tiny") as folder:
                export_sam(encoder, decoder, folder)
                write_sam_card(folder, encoder, decoder, unseen, _described(recipe, threads), curve, metrics)
        with stage_log("train", "clip-tiny") as counts:
            crops = collect_crops(
                training, _rough_masks(encoder, decoder, training, ROUGH_VIEWS), seed, copies=COPIES
            )
            others = collect_crops(
                unseen, _rough_masks(encoder, decoder, unseen, len(unseen)), seed, jitter=False
            )
            counts["crops"] = len(crops.crops)
            vision, text, tokenizer, curve = train_clip(crops, others, clip_steps, seed)
            texts = [phrases[0] for phrases in crops.phrase_sets]
            found = measure_clip(vision, text, tokenizer, others, texts)
            metrics = {kind: {} for kind, _ in found}
            for (kind, level), value in found.items():
                metrics[kind][level] = value
            with atomic_folder(out / "clip-tiny") as folder:
                export_clip(vision, text, tokenizer, folder)
                described = _described(recipe, threads) | {
                    "crops": len(crops.crops),
                    "rough_crops": int(crops.rough.sum()),
                    "texts_competing": len(set(texts)),
                }
                write_clip_card(folder, described, curve, metrics)
    finally:
        torch.set_num_threads(threads_before)


def _described(recipe: Recipe, threads: int) -> dict[str, object]:
    """The recipe as it goes into a card."""
    train_seeds, other_seeds = training_seeds(recipe.scenes, recipe.validation_scenes)
    return asdict(recipe) | {
        "generator": generator_digest(),
        "training_seeds": [train_seeds[0], train_seeds[-1]],
        "validation_seeds": [other_seeds[0], other_seeds[-1]],
        "threads": threads,
        "torch": torch.__version__,
    }


def _trained_sam(
    training: LabelledViews, unseen: LabelledViews, recipe: Recipe, cache: Path, threads: int
) -> tuple[SamEncoder, SamDecoder, Curve]:
    """Train the segmenter, or take the one this recipe already gave."""
    record = asdict(recipe) | {"clip_steps": 0, "threads": threads, "version": RECIPE_VERSION}
    record["generator"] = generator_digest()
    path = cache / f"sam-{sha256_of_json(record)[:12]}.safetensors"
    if path.is_file():
        logger.info("taking the segmenter trained before: %s", path)
        encoder, decoder = SamEncoder(), SamDecoder()
        weights = load_file(path)
        _load(encoder, weights, "encoder.")
        _load(decoder, weights, "decoder.")
        return encoder.eval(), decoder.eval(), Curve(read_json(path.with_suffix(".json")))
    encoder, decoder, curve = train_sam(training, unseen, recipe.sam_steps, recipe.seed)
    weights = {f"encoder.{name}": value.contiguous().numpy() for name, value in encoder.state_dict().items()}
    weights |= {f"decoder.{name}": value.contiguous().numpy() for name, value in decoder.state_dict().items()}
    write_json(path.with_suffix(".json"), curve.rows)
    with atomic_path(path) as temporary:
        save_file(weights, temporary)
    return encoder, decoder, curve


def _load(module: nn.Module, weights: dict[str, np.ndarray], prefix: str) -> None:
    module.load_state_dict(
        {name: torch.from_numpy(weights[f"{prefix}{name}"]) for name in module.state_dict()}
    )


def _rough_masks(
    encoder: SamEncoder, decoder: SamDecoder, views: LabelledViews, count: int
) -> list[list[RoughMask]]:
    """The segmenter's own masks of the first views; none for the others."""
    found = [
        segment_everything(encoder, decoder, image, ROUGH_PROMPTS)
        for image in track(views.images[:count], "rough masks")
    ]
    return found + [[] for _ in range(len(views) - len(found))]
