"""Recipe of the small embedded models: render, train, measure, export, and write the model cards."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from hilsplat.base.artifacts import atomic_folder, sha256_of_json, write_text
from hilsplat.base.errors import ModelError, SettingsError
from hilsplat.base.progress import stage_log
from hilsplat.segment.sam import SamModel
from models.training.card import RECORD, write_clip_card, write_sam_card
from models.training.crops import list_crops, list_segmented
from models.training.data import LabelledViews
from models.training.export import export_clip, export_sam
from models.training.measure_clip import measure_clip, measure_queries
from models.training.measure_sam import (
    automatic_masks,
    cached_masks,
    measure_everything,
    measure_sam,
)
from models.training.render import generator_digest, kind_of_seed, render_training_views, training_seeds
from models.training.settings import TrainingSettings
from models.training.steps import Budget, Curve
from models.training.train_clip import train_clip
from models.training.train_sam import train_sam
from models.training.vocabulary import world_vocabulary

logger = logging.getLogger(__name__)

RECIPE_VERSIONS = {"sam": 2, "clip": 3}
"""Increment a version when networks, windows or losses change, so that cached trainings start again."""
STAGES = ("render", "sam", "clip")
AUTOMATIC_VIEWS = 48
"""Number of unseen views that are segmented automatically to measure recall."""


ROUGH_PROMPTS = 20
"""Prompts per image side when training views are segmented for CLIP, fewer than at run time."""


@dataclass(frozen=True)
class Material:
    """Rendered views and their origin.

    Attributes:
        training: views for training.
        unseen: views of other scenes, for validation.
        unseen_kinds: scene kind of each unseen view.
        described: description of the views for the cards.
    """

    training: LabelledViews
    unseen: LabelledViews
    unseen_kinds: tuple[str, ...]
    described: dict[str, Any]


def train_models(
    out: Path,
    cache: Path,
    settings: TrainingSettings,
    seed: int = 0,
    threads: int = 2,
    stages: Sequence[str] | None = None,
) -> None:
    """Train the small SAM and CLIP on training scenes of the synthetic world, and write both model folders.

    Views and training states are cached: an interrupted run resumes, and a finished one with a new budget
    resumes from the state before its learning rate decay.

    Args:
        out: folder for `sam-tiny` and `clip-tiny`.
        cache: folder of rendered views and training states.
        settings: numbers of scenes, and duration of the training.
        seed: seed of everything random except the scenes.
        threads: threads of torch, and number of rendering and segmenting processes.
        stages: some of `STAGES`, by default all; `clip` needs `sam-tiny` in `out`.

    Raises:
        SettingsError: if a stage is unknown.
        ModelError: if `clip` is requested and `out` has no segmenter.
    """
    stages = STAGES if stages is None else tuple(stages)
    if not set(stages) <= set(STAGES):
        raise SettingsError(
            "unknown stage of training", expected=f"some of {', '.join(STAGES)}", found=str(stages)
        )
    out, cache = Path(out), Path(cache)
    material = rendered(cache, settings, threads)
    threads_before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        if "sam" in stages:
            _make_sam(out / "sam-tiny", cache, material, settings, seed, threads)
        if "clip" in stages:
            _make_clip(out, cache, material, settings, seed, threads)
    finally:
        torch.set_num_threads(threads_before)


def require_own_models(out: Path) -> None:
    """Check that training does not replace another model.

    Raises:
        ModelError: if an output folder contains something other than a model trained by this package.
    """
    for name in ("sam-tiny", "clip-tiny"):
        folder = Path(out) / name
        if folder.exists() and any(folder.iterdir()) and not (folder / RECORD).is_file():
            raise ModelError(
                f"{folder} is there, and no training wrote it", fix="name another folder, or remove it first"
            )


def rendered(cache: Path, settings: TrainingSettings, threads: int) -> Material:
    """Return the views of a recipe, and render those that the cache lacks."""
    train_seeds, other_seeds = training_seeds(settings.scenes, settings.validation_scenes)
    with stage_log("render", "training scenes") as counts:
        training = render_training_views(cache, train_seeds, settings.views, threads)
        unseen = render_training_views(cache, other_seeds, settings.views, threads)
        counts["views"], counts["unseen"] = len(training), len(unseen)
    kinds = [kind_of_seed(seed)[0] for seed in train_seeds]
    described = {
        "generator": generator_digest(),
        "scenes": settings.scenes,
        "views": settings.views,
        "validation_scenes": settings.validation_scenes,
        "training_seeds": [train_seeds[0], train_seeds[-1]],
        "validation_seeds": [other_seeds[0], other_seeds[-1]],
        "kinds": {kind: kinds.count(kind) for kind in sorted(set(kinds))},
    }
    of_view = tuple(kind_of_seed(seed)[0] for seed in other_seeds for _ in range(settings.views))
    return Material(training, unseen, of_view, described)


def _state_name(model: str, material: Material, seed: int, more: Mapping[str, Any]) -> str:
    """Return a name derived from everything that the weights depend on, except the budget."""
    key = {"model": model, "seed": seed, "version": RECIPE_VERSIONS[model], **material.described, **more}
    return f"{model}-{sha256_of_json(key)[:12]}"


def _described(
    model: str,
    material: Material,
    settings: TrainingSettings,
    budget: Budget,
    seed: int,
    threads: int,
    curve: Curve,
) -> dict[str, Any]:
    """Return the recipe for a card."""
    return material.described | {
        "budget": asdict(budget),
        "steps": int(curve.rows[-1]["step"]),
        "minutes": curve.rows[-1]["minutes"],
        "seed": seed,
        "threads": threads,
        "device": settings.device,
        "torch": torch.__version__,
        "version": RECIPE_VERSIONS[model],
    }


def _make_sam(
    folder: Path, cache: Path, material: Material, settings: TrainingSettings, seed: int, threads: int
) -> None:
    budget = Budget(settings.sam_minutes, settings.sam_steps)
    with stage_log("train", "sam-tiny") as counts:
        name = _state_name("sam", material, seed, {})
        encoder, decoder, curve = train_sam(
            material.training, material.unseen, budget, seed, cache, name, device=settings.device
        )
        with atomic_folder(folder) as temporary:
            export_sam(encoder, decoder, temporary)
            points, automatic = {}, {}
            for group, views in by_kind(material).items():
                points[group] = measure_sam(encoder, decoder, views)
                masks = automatic_masks(temporary, views.spread(AUTOMATIC_VIEWS), threads)
                automatic[group] = measure_everything(masks, views.spread(AUTOMATIC_VIEWS))
            counts.update({level: f"{value['iou']:.3f}" for level, value in points["all"].items()})
            recipe = _described("sam", material, settings, budget, seed, threads, curve)
            metrics = {"points": points, "automatic": automatic}
            write_sam_card(temporary, encoder, decoder, material.unseen, recipe, curve, metrics)


def _make_clip(
    out: Path, cache: Path, material: Material, settings: TrainingSettings, seed: int, threads: int
) -> None:
    budget = Budget(settings.clip_minutes, settings.clip_steps)
    segmenter = out / "sam-tiny"
    with stage_log("train", "clip-tiny") as counts:
        digest = SamModel.load(segmenter).digest
        views, unseen = material.training, material.unseen.spread(AUTOMATIC_VIEWS)
        count = min(settings.segmented_views, len(views))
        masks = cached_masks(cache, segmenter, digest, views, count, ROUGH_PROMPTS, threads)
        other_masks = cached_masks(cache, segmenter, digest, unseen, len(unseen), None, threads)
        crops, others = list_crops(views, masks), list_crops(unseen, other_masks)
        counts["masks"] = len(crops)
        name = _state_name("clip", material, seed, {"segmenter": digest, "segmented_views": count})
        vision, text, tokenizer, curve = train_clip(
            crops, others, budget, seed, cache, name, device=settings.device
        )
        metrics: dict[str, Any] = {}
        for background in ("black", "keep"):
            found = measure_clip(vision, text, tokenizer, others, background=background)
            for (kind, level), value in found.items():
                metrics.setdefault(background, {}).setdefault(kind, {})[level] = value
        metrics["queries"] = measure_queries(
            vision, text, tokenizer, unseen, other_masks, list_segmented(unseen, other_masks)
        )
        counts.update({level: f"{v['top1']:.3f}" for level, v in metrics["black"]["exact"].items()})
        recipe = _described("clip", material, settings, budget, seed, threads, curve) | {
            "segmenter": digest,
            "masks": len(crops),
            "segmented_masks": int(crops.rough.sum()),
            "texts_competing": len({phrases[0] for phrases in others.phrase_sets}),
        }
        with atomic_folder(out / "clip-tiny") as temporary:
            write_text(temporary / "vocabulary.txt", world_vocabulary())
            export_clip(vision, text, tokenizer, temporary)
            write_clip_card(temporary, recipe, curve, metrics)


def by_kind(material: Material) -> dict[str, LabelledViews]:
    """Return all unseen views, and those of each scene kind."""
    groups = {"all": material.unseen}
    for kind in dict.fromkeys(material.unseen_kinds):
        rows = [row for row, of_view in enumerate(material.unseen_kinds) if of_view == kind]
        views = material.unseen
        groups[kind] = LabelledViews(
            views.images[rows], views.labels[rows], tuple(views.nodes[row] for row in rows)
        )
    return groups
