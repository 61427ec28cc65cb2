"""Threads, memory, time and GPUs of a job, from the size of its scene and its settings.

`resources.tsv` lists each rule's core seconds per megapixel of all views, and the terms of its memory in
megabytes: a base, and amounts per megapixel of all views (`mp`, and `capped_mp` up to `cap`), per megapixel
of one view (`view_mp`, and `thread_mp` per thread), and per thousand Gaussians (`thousand` up to 2**20,
`more_thousand` for all others). It also lists megabytes on disk (with caches) per megapixel of all views and
per thousand Gaussians (for fields: times latent channels). These estimates exceed the peaks in Snakemake's
`benchmark:` records (tests/unit/workflow/peak_memory.tsv; `source` and `train_models` were not measured).
Times were measured on benchmark scenes and can be off by a factor of three elsewhere. A killed job is retried
with twice the memory and time limit.
"""

import csv
import functools
import json
import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hilsplat.base.artifacts import read_npz
from hilsplat.base.cards import cards
from hilsplat.base.errors import ArtifactError, ImageError, ModelError
from hilsplat.base.images import opened_image
from hilsplat.base.levels import LEVELS
from hilsplat.base.memory import MIB
from hilsplat.baselines import TrainedSettings
from hilsplat.configuration import SECTIONS, StageSettings
from hilsplat.datasets.generators import GENERATORS
from hilsplat.datasets.sources import is_exported
from hilsplat.models.card import card_problem
from hilsplat.models.store import RELEASES, model_path, planned_model
from hilsplat.scene.layouts import vertex_count
from hilsplat.scene.sheet import SceneRow
from hilsplat.semantic_tree.limits import MAX_ALL
from hilsplat.settings import GaussiansSettings, MasksSettings
from hilsplat.splat.rasterise.device import expected_problem
from hilsplat.splat.steps import fit_steps
from hilsplat.stages import all_stages, family_of, stage_of
from hilsplat.workflow.plan import SCORED, Plan
from hilsplat.workflow.scene_data import Job

with Path(__file__).with_suffix(".tsv").open(encoding="utf-8") as _stream:
    _rows = list(csv.DictReader(_stream, delimiter="\t"))
COSTS = {row.pop("stage"): {name: float(value) for name, value in row.items()} for row in _rows}
"""Stage -> its terms (`cost_name`)."""

GPU: dict[str, Any] = json.loads(Path(__file__).with_name("gpu.json").read_text(encoding="utf-8"))
"""Seconds on a card, as `python -m benchmarks.gpu` writes them: of a step of the fit, per step, megapixel and
Gaussian; of a picture in SAM, by part of the model's name; of a crop in CLIP."""

MEAN_SHARE = 0.75
"""Mean number of Gaussians over a fit, as a share of the maximum, reached after about half of the steps."""

MP_PER_THREAD = 2.0  # megapixels of all views per thread
RUNNER_MB = 700  # memory of the two Snakemake processes that a cluster job starts before its stage
BLOCK = 2**20 / 1000  # thousands of Gaussians that the field solves together by default
TIME_FACTOR, MIN_MINUTES = 6, 10  # ratio of a job's time limit to its estimate, and minimum limit
START_S = 2.0  # seconds to start Python, load libraries and read the inputs of a job

FIT_S_PER_MP, FIT_S_PER_GAUSSIAN, GRAPH_S_PER_MP = 0.14, 0.9e-6, 4.0
"""Core seconds of a fit step per megapixel of the view, and per Gaussian that the fit may have; core seconds
of the graph segmenter per megapixel."""

TRAINED_S_PER_MP = 0.08  # core seconds per step, level and megapixel of a trained baseline

QUERY_S_PER_MP = 0.24
"""Core seconds to score a labelled query per megapixel of its view: 74 s for 2092 queries at 384 x 384 px, by
tree and field (docs/benchmarks.md)."""

NETWORK_S = 10.0  # core seconds to train an autoencoder
EMBEDDED_S = {"masks": 1.5, "clip": 0.1}  # core seconds of the embedded models per view

SAM_S, OTHER_SAM_S = {"huge": 87.0, "large": 44.0, "base": 14.1}, 5.7
"""Part of a SAM model's name -> core seconds per picture; others use SAM 2.1 small's (docs/benchmarks.md)."""

PROMPT_S, PICTURE_S, CROP_S = 0.02, 1.0, 0.3
"""Core seconds per SAM prompt, per picture from logits to masks, and per crop in CLIP B/16."""

PREVIEWED, GUIDED = 0.65, 0.25
"""Relative cost of a prompt with preview, and share of the grid's prompts that guided views use."""

CANDIDATES = (
    *("model", "variant", "precision", "generator", "points_per_side", "crop_layers", "stability_offset"),
    *("prompts", "key_views"),
)
"""Settings of masks that the candidates of SAM depend on."""

MASKS, NODES = 230, 400
"""Typical numbers of masks per photograph and nodes per room, from `plush_bedroom` (docs/benchmarks.md)."""

UNKNOWN_MP = 0.5  # megapixels assumed per view if no image header can be read before the run


OTHER = {"base": 500.0} | {name: 0.0 for name in next(iter(COSTS.values())) if name != "base"}
"""Cost of rules that are not listed: those without a scene."""


def cost_name(rule: str) -> str:
    """Return the listed stage whose cost a rule has: its own, or the main stage of its artifact."""
    stage = all_stages().get(rule)
    return rule if rule in COSTS or stage is None else family_of(stage)


class Size(NamedTuple):
    """Size of a scene; `view_mp` is the number of megapixels of one view."""

    views: int
    view_mp: float


class JobResources:
    """Resources of the jobs of a plan, as functions of wildcards that Snakemake calls.

    Given this machine's `cores`, jobs get one thread each if there are enough jobs for all cores. On a
    cluster, `cores` is None: a job recomputes its resources on its node, so they must not depend on cores.
    """

    def __init__(self, plan: Plan, cores: int | None = None) -> None:
        self.plan, self.cores = plan, cores
        self._per_scene = math.inf if cores is None else max(1, cores // max(1, len(plan.scenes)))
        many = cores is not None and len(plan.run.variant_names()) >= cores
        self._per_variant = 1 if many else self._per_scene
        self.size = functools.cache(self._size)
        self.gaussians, self.fitted = functools.cache(self._gaussians), functools.cache(self._fitted)
        self.queries = functools.cache(plan.data.num_labelled)
        self._seconds = functools.cache(self._estimate)

    def threads(self, wildcards: Job) -> int:
        """Return a number of threads proportional to the scene's pixels, up to the core limit per scene."""
        views, view_mp = self.size(self.plan.row(wildcards))
        return int(min(max(1, math.ceil(views * view_mp / MP_PER_THREAD)), self._per_scene))

    def variant_threads(self, wildcards: Job) -> int:
        """Return the number of threads for a rule with many short jobs per scene, which run in parallel."""
        return int(min(self.threads(wildcards), self._per_variant))

    def of(self, name: str) -> dict[str, Callable[..., int]]:
        """Return the resources of a stage's rule."""
        stage = stage_of(name)
        resources = {"mem_mb": self.memory_mb(name), "runtime": self.minutes(name)}
        sections = [name for name in stage.sections.values() if "device" in SECTIONS[name].model_fields]
        if sections:
            resources["gpu"] = self.gpus(sections[0])
        return resources

    def memory_mb(self, rule: str) -> Callable[..., int]:
        """Return the function for the resource `mem_mb` of a rule."""

        def needed(wildcards: Any, threads: int, attempt: int) -> int:
            cost = COSTS.get(cost_name(rule), OTHER)
            mb = cost["base"]
            if hasattr(wildcards, "scene"):
                row = self.plan.row(wildcards)
                (views, view_mp), thousand = self.size(row), self.gaussians(row) / 1000
                mb += (cost["mp"] * views + cost["view_mp"] + cost["thread_mp"] * threads) * view_mp
                mb += min(cost["cap"], cost["capped_mp"] * views * view_mp)
                mb += cost["thousand"] * min(thousand, BLOCK) + cost["more_thousand"] * max(
                    0, thousand - BLOCK
                )
                if cost_name(rule) == "semantic_tree":
                    mb = max(mb, cost["base"] + cost["thousand"] * thousand + _pairs_mb(views))
                mb = max(mb, self._model_mb(cost_name(rule), wildcards, threads))
            return math.ceil((mb + RUNNER_MB) / 100) * 100 * 2 ** (attempt - 1)

        return needed

    def minutes(self, rule: str) -> Callable[..., int]:
        """Return the function for the resource `runtime` of a rule."""

        def needed(wildcards: Any, threads: int, attempt: int) -> int:
            seconds = self.core_seconds(rule, wildcards) / threads if hasattr(wildcards, "scene") else 0.0
            minutes = max(MIN_MINUTES, TIME_FACTOR * seconds / 60)
            return math.ceil(minutes / 5) * 5 * 2 ** (attempt - 1)

        return needed

    def gpus(self, section: str) -> Callable[[Job], int]:
        """Return the function for the resource `gpu`: 1 for jobs that use a card.

        For `device: auto`, these are jobs on this machine if it has a card; nodes of a cluster are unknown.
        """
        problem = expected_problem if section in ("gaussians", "contributions") else card_problem
        has_card = functools.cache(lambda: self.cores is not None and bool(cards()) and problem() is None)

        def needed(wildcards: Any) -> int:
            row, settings = self.plan.row(wildcards), getattr(self.plan.stages(wildcards), section)
            if _is_imported(section, row) or not settings.uses_card:
                return 0
            return int(settings.device == "cuda" or has_card())

        return needed

    def disk_mb(self, rule: str, job: Job) -> float:
        """Return the megabytes that a scene's job writes, including caches."""
        row, cost = self.plan.row(job), COSTS.get(cost_name(rule), OTHER)
        views, view_mp = self.size(row)
        of_gaussians = cost["disk_thousand"] * self.gaussians(row) / 1000
        if rule in ("field", "method"):
            of_gaussians *= self.plan.stages(job).autoencoder.latent
        return cost["disk_mp"] * views * view_mp + of_gaussians

    def core_seconds(self, rule: str, job: Job) -> float:
        """Return the estimated core seconds of a scene's job."""
        row, rule = self.plan.row(job), cost_name(rule)
        if _is_imported(rule, row):  # reading a view's files is assumed to take as long as an embedded model
            return START_S + EMBEDDED_S.get(rule, 0.0) * self.size(row).views
        seconds = self._seconds(rule, *self.plan.which(job), self.size(row), self.fitted(row))
        if rule == SCORED:
            seconds = max(seconds, QUERY_S_PER_MP * self.queries(row) * self.size(row).view_mp)
        return START_S + seconds

    def card_seconds(self, rule: str, job: Job) -> float | None:
        """Return how many seconds a job would take on a card (`GPU`), or None if it has no work for one."""
        rule, stages, row = cost_name(rule), self.plan.stages(job), self.plan.row(job)
        if _is_imported(rule, row):
            return None
        views, view_mp = self.size(row)
        if rule == "gaussians":
            steps, seen_mp = _steps_and_mp(stages.gaussians, views, view_mp)
            per_gaussian = GPU["fit_step_s_per_gaussian"] * MEAN_SHARE * self.fitted(row)
            return START_S + steps * (GPU["fit_step_s"] + GPU["fit_step_s_per_mp"] * seen_mp + per_gaussian)
        if not self._uses_network(rule, stages):
            return None
        if rule == "clip":
            return START_S + GPU["clip_crop_s"] * _crops(stages, views)
        named = GPU["sam_picture_s"]
        picture_s = next(cost for word, cost in named.items() if word in stages.masks.model)
        return START_S + picture_s * views * stages.masks.key_views * _pictures(stages.masks)

    def candidates(self, rule: str, job: Job) -> tuple[Any, ...] | None:
        """Return what the candidates of a job's SAM depend on, or None; jobs of a scene share cached ones."""
        stages, row = self.plan.stages(job), self.plan.row(job)
        rule = cost_name(rule)
        if rule != "masks" or _is_imported(rule, row) or not self._uses_network(rule, stages):
            return None
        return row.name, *(getattr(stages.masks, name) for name in CANDIDATES)

    def _uses_network(self, rule: str, stages: StageSettings) -> bool:
        """Return whether a job runs a released SAM or CLIP."""
        if rule not in EMBEDDED_S or (rule == "masks" and stages.masks.segmenter != "sam"):
            return False
        model = planned_model(Path(getattr(stages, rule).model))
        return model is not None and not model.embedded

    def _estimate(self, rule: str, variant: str, scopes: tuple[str, ...], size: Size, fitted: int) -> float:
        stages = self.plan.stages_of(variant, scopes)
        views, view_mp = size
        if rule == "gaussians":
            fit = stages.gaussians
            steps, seen_mp = _steps_and_mp(fit, views, view_mp)
            return steps * (FIT_S_PER_MP * seen_mp + FIT_S_PER_GAUSSIAN * fitted)
        if rule == "masks" and stages.masks.segmenter == "graph":
            return GRAPH_S_PER_MP * views * view_mp
        if rule in EMBEDDED_S:
            if not self._uses_network(rule, stages):
                return views * EMBEDDED_S[rule]
            return views * _sam_s(stages.masks) if rule == "masks" else CROP_S * _crops(stages, views)
        if rule == "method" and isinstance(stages.method, TrainedSettings):
            pixels_mp = view_mp / stages.method.pixel_step**2
            return TRAINED_S_PER_MP * len(LEVELS) * stages.method.steps * pixels_mp
        if rule == "method":
            return COSTS["field"]["core_s_per_mp"] * views * view_mp
        if rule == "autoencoder" and stages.autoencoder.code == "network":
            return NETWORK_S
        return COSTS.get(rule, OTHER)["core_s_per_mp"] * views * view_mp

    def _size(self, row: SceneRow) -> Size:
        """Return the size of a scene from its cameras, or from its settings or image headers."""
        cameras, stages = Path(self.plan.path(row, "scene")) / "cameras.npz", self.plan.stages(row)
        if cameras.is_file():
            with suppress(ArtifactError):  # it is damaged, and will be written again
                sizes = read_npz(cameras, "size_hw")["size_hw"].astype(np.float64)
                return Size(len(sizes), float(sizes.prod(axis=1).mean()) / 1e6)
        if row.generated:
            return Size(*GENERATORS[row.generated.generator].size(stages))
        first_mp = _first_mp(self.plan.data.photographs(row), stages.poses.max_side_px)
        return Size(self.plan.data.num_images(row), first_mp)

    def _gaussians(self, row: SceneRow) -> int:
        """Return the number of Gaussians in the PLY that replaces the fit, or of the fit at most."""
        known = vertex_count(row.gaussians) if row.gaussians is not None else None
        return known or self.fitted(row)

    def _fitted(self, row: SceneRow) -> int:
        """Return the limit of a fit or, if its Gaussians are frozen at vertices of a mesh, their number."""
        fit, files = self.plan.stages(row).gaussians, list[str]()
        if fit.initial == "frozen" and is_exported(row.source):
            files = self.plan.data.source_files(row)
        meshes = (Path(file) for file in files if file.endswith(".ply"))
        return next(filter(None, map(vertex_count, meshes)), fit.max_gaussians)

    def _model_mb(self, rule: str, wildcards: Job, threads: int) -> int:
        """Return a model's memory with one view per thread, MB; the stage uses at most the free memory."""
        if rule not in EMBEDDED_S or _is_imported(rule, self.plan.row(wildcards)):
            return 0
        settings = getattr(self.plan.stages(wildcards), rule)
        if getattr(settings, "segmenter", "sam") != "sam":
            return 0
        batch = settings.batch if rule == "clip" else settings.points_per_batch
        return _model_memory_mb(model_path(settings.model), settings.variant, batch, threads)


def _is_imported(rule: str, row: SceneRow) -> bool:
    """Return whether a user's files replace Gaussians, masks or CLIP vectors that a rule would compute."""
    return row.gaussians is not None if rule == "gaussians" else rule in EMBEDDED_S and bool(row.features)


def _pairs_mb(views: int) -> float:
    """Return the memory for the pairs of masks that are compared, with about 400 masks per view, MB.

    The stage counts them, and refuses to start if they need more.
    """
    return 0.12 * views**2 if views <= MAX_ALL else 4.0 * views


def _steps_and_mp(fit: GaussiansSettings, views: int, view_mp: float) -> tuple[int, float]:
    """Return the steps of a fit, and the mean megapixels of a step."""
    small, half = fit.quarter_until, max(fit.half_until - fit.quarter_until, 0.0)
    seen_mp = view_mp * fit.image_scale**2 * (small / 16 + half / 4 + max(1 - small - half, 0.0))
    return fit_steps(fit, views), seen_mp


def _crops(stages: StageSettings, views: int) -> int:
    return views * MASKS if stages.clip.crops == "masks" else NODES * stages.clip.crops_per_node


def _pictures(masks: MasksSettings) -> int:
    """Return the number of pictures per view that SAM encodes: the view and its crops."""
    return sum(4**layer for layer in range(masks.crop_layers + 1))


def _sam_s(masks: MasksSettings) -> float:
    """Return a full-size SAM model's core seconds for a view and its crops, times the share of key views."""
    picture_s = next((cost for word, cost in SAM_S.items() if word in masks.model), OTHER_SAM_S)
    share = 1.0 if masks.generator == "official" else PREVIEWED
    prompts = masks.points_per_side**2 * share * (GUIDED if masks.prompts == "guided" else 1.0)
    return masks.key_views * _pictures(masks) * (picture_s + PICTURE_S + prompts * PROMPT_S)


def _first_mp(images: Iterable[Path], max_side_px: int) -> float:
    """Return the megapixels of the first image with a readable header, scaled as `poses` scales it."""
    for image in images:
        try:
            with opened_image(image) as opened:
                width, height = opened.size
        except ImageError:  # labels, sheets and other files next to the images
            continue
        return width * height * min(1.0, max_side_px / max(width, height)) ** 2 / 1e6
    return UNKNOWN_MP


@functools.cache
def _model_memory_mb(folder: Path, variant: str, batch: int | str, threads: int) -> int:
    """Return the memory of a stage's model, MB; 0 if the folder is unreadable (the stage reports it).

    For a released model that is missing, it is the size of the download, a lower limit.
    """
    from hilsplat.models.folder import open_model_folder
    from hilsplat.models.memory import needs_of  # onnxruntime is slow to import
    from hilsplat.segment.thresholds import own_thresholds

    try:
        model = open_model_folder(folder, variant=variant)
        prompts = own_thresholds(model).points_per_batch if isinstance(batch, str) else batch
    except ModelError:
        known = {release.name: release.megabytes for release in RELEASES}
        return 0 if folder.exists() else known.get(folder.name, 0)
    return round(needs_of(model, prompts).total_mib(threads) * MIB / 1e6)
