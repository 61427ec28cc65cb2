"""Recipe of the small embedded models: render, train, measure, export, and write the model cards."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from hilsplat.base.artifacts import write_text
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import ModelError, SettingsError
from hilsplat.base.lineage import sha256_of_json
from hilsplat.base.progress import stage_log
from hilsplat.segment.sam import SamModel
from models.training import render
from models.training.card import RECORD, write_clip_card, write_sam_card
from models.training.crops import list_crops
from models.training.data import LabelledViews
from models.training.export import export_clip, export_sam
from models.training.loop import Budget, Curve
from models.training.measure_clip import measure_clip, measure_queries
from models.training.measure_sam import automatic_masks, measure_everything, measure_sam
from models.training.settings import TrainingSettings
from models.training.train_clip import train_clip
from models.training.train_sam import train_sam

# Increment a version when networks, windows or losses change, so that cached trainings start again.
RECIPE_VERSIONS = {"sam": 2, "clip": 3}
STAGES = ("render", "sam", "clip")
AUTOMATIC_VIEWS = 48  # number of held-out views that are segmented automatically to measure recall
ROUGH_PROMPTS = 20  # prompts per image side to segment training views for CLIP; fewer than at run time


@dataclass(frozen=True)
class Recipe:
    """Rendered views, and settings of the trainings with them."""

    cache: Path
    settings: TrainingSettings
    seed: int
    threads: int
    training: LabelledViews
    unseen: LabelledViews  # views of other scenes, for validation
    unseen_kinds: tuple[str, ...]  # scene kind of each unseen view
    described: dict[str, Any]  # description of the views for the cards

    def state_name(self, model: str, **more: Any) -> str:
        """Return a name derived from everything that the weights depend on, except the budget."""
        key = {"model": model, "seed": self.seed, "version": RECIPE_VERSIONS[model], **self.described, **more}
        return f"{model}-{sha256_of_json(key)[:12]}"

    def description(self, model: str, budget: Budget, curve: Curve) -> dict[str, Any]:
        """Return the recipe of a model for its card."""
        return self.described | {
            "budget": asdict(budget),
            "steps": int(curve[-1]["step"]),
            "minutes": curve[-1]["minutes"],
            "seed": self.seed,
            "threads": self.threads,
            "device": self.settings.device,
            "torch": torch.__version__,
            "version": RECIPE_VERSIONS[model],
        }


def train_models(
    out: Path,
    cache: Path,
    settings: TrainingSettings,
    seed: int = 0,
    threads: int = 2,
    stages: Sequence[str] | None = None,
) -> None:
    """Train the small SAM and CLIP on training scenes of the synthetic world, and write both model folders.

    Rendered views and training states are cached: an interrupted run resumes, and a finished one with a new
    budget resumes from the state before its learning rate decay.

    Args:
        out: folder for `sam-tiny` and `clip-tiny`.
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
            "unknown training step", expected=f"one or more of {', '.join(STAGES)}", found=str(stages)
        )
    recipe = render_views(Path(cache), settings, seed, threads)
    threads_before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        if "sam" in stages:
            _make_sam(Path(out), recipe)
        if "clip" in stages:
            _make_clip(Path(out), recipe)
    finally:
        torch.set_num_threads(threads_before)


def require_own_models(out: Path) -> None:
    """Raise ModelError if an output folder contains something other than a model trained by this package."""
    for name in ("sam-tiny", "clip-tiny"):
        folder = Path(out) / name
        if folder.exists() and any(folder.iterdir()) and not (folder / RECORD).is_file():
            raise ModelError(
                f"{folder} exists, but contains no model trained by this package",
                fix="choose another --out folder, or remove it first",
            )


def render_views(cache: Path, settings: TrainingSettings, seed: int, threads: int) -> Recipe:
    """Return a recipe with its views, and render those that are not in the cache."""
    train_seeds, other_seeds = render.training_seeds(settings.scenes, settings.validation_scenes)
    with stage_log("render", "training scenes") as counts:
        training = render.render_training_views(cache, train_seeds, settings.views, threads)
        unseen = render.render_training_views(cache, other_seeds, settings.views, threads)
        counts["views"], counts["unseen"] = len(training), len(unseen)
    kinds = [render.kind_of_seed(seed)[0] for seed in train_seeds]
    described = {
        "generator": render.generator_digest(),
        "scenes": settings.scenes,
        "views": settings.views,
        "validation_scenes": settings.validation_scenes,
        "training_seeds": [train_seeds[0], train_seeds[-1]],
        "validation_seeds": [other_seeds[0], other_seeds[-1]],
        "kinds": {kind: kinds.count(kind) for kind in sorted(set(kinds))},
    }
    of_view = tuple(render.kind_of_seed(seed)[0] for seed in other_seeds for _ in range(settings.views))
    return Recipe(cache, settings, seed, threads, training, unseen, of_view, described)


def _make_sam(out: Path, recipe: Recipe) -> None:
    settings, threads = recipe.settings, recipe.threads
    budget = Budget(settings.sam_minutes, settings.sam_steps)
    with stage_log("train", "sam-tiny") as counts:
        name = recipe.state_name("sam")
        encoder, decoder, curve = train_sam(
            recipe.training, recipe.unseen, budget, recipe.seed, recipe.cache, name, device=settings.device
        )
        with atomic_folder(out / "sam-tiny") as folder:
            export_sam(encoder, decoder, folder)
            points, automatic = {}, {}
            for group, views in by_kind(recipe).items():
                points[group] = measure_sam(encoder, decoder, views)
                few = views.spread(AUTOMATIC_VIEWS)
                masks = automatic_masks(recipe.cache, folder, few.images, threads)
                automatic[group] = measure_everything(masks, few)
            counts.update({level: f"{value['iou']:.3f}" for level, value in points["all"].items()})
            metrics = {"points": points, "automatic": automatic}
            description = recipe.description("sam", budget, curve)
            write_sam_card(folder, encoder, decoder, recipe.unseen, description, curve, metrics)


def _make_clip(out: Path, recipe: Recipe) -> None:
    settings, threads, segmenter = recipe.settings, recipe.threads, out / "sam-tiny"
    budget = Budget(settings.clip_minutes, settings.clip_steps)
    with stage_log("train", "clip-tiny") as counts:
        digest = SamModel.load(segmenter).digest
        views, unseen = recipe.training, recipe.unseen.spread(AUTOMATIC_VIEWS)
        count = min(settings.segmented_views, len(views))
        masks = automatic_masks(recipe.cache, segmenter, views.images[:count], threads, ROUGH_PROMPTS)
        unseen_masks = automatic_masks(recipe.cache, segmenter, unseen.images, threads)
        crops, others = list_crops(views, masks), list_crops(unseen, unseen_masks)
        counts["masks"] = len(crops)
        name = recipe.state_name("clip", segmenter=digest, segmented_views=count)
        clip, curve = train_clip(
            crops, others, budget, recipe.seed, recipe.cache, name, device=settings.device
        )
        metrics: dict[str, Any] = {}
        for background in ("black", "keep"):
            accuracies = measure_clip(clip, others, background=background)
            for (kind, level), value in accuracies.items():
                metrics.setdefault(background, {}).setdefault(kind, {})[level] = value
        metrics["queries"] = measure_queries(clip, unseen, unseen_masks)
        counts.update({level: f"{v['top1']:.3f}" for level, v in metrics["black"]["exact"].items()})
        description = recipe.description("clip", budget, curve) | {
            "segmenter": digest,
            "masks": len(crops),
            "segmented_masks": int(crops.rough.sum()),
            "texts_competing": len({phrases[0] for phrases in others.phrase_sets}),
        }
        with atomic_folder(out / "clip-tiny") as folder:
            write_text(folder / "vocabulary.txt", render.world_vocabulary())
            export_clip(clip, folder)
            write_clip_card(folder, description, curve, metrics)


def by_kind(recipe: Recipe) -> dict[str, LabelledViews]:
    """Return all unseen views, and those of each scene kind."""
    groups = {"all": recipe.unseen}
    for kind in dict.fromkeys(recipe.unseen_kinds):
        rows = [row for row, of_view in enumerate(recipe.unseen_kinds) if of_view == kind]
        groups[kind] = recipe.unseen.chosen(rows)
    return groups
