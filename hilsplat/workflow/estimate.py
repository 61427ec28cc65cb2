"""Estimates for the user: the jobs of a dry run, and the time until photographs can be queried."""

import subprocess
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from hilsplat.base.tables import aligned_table
from hilsplat.models.store import read_model
from hilsplat.scene.finished import KEY_VIEWS
from hilsplat.scene.sheet import PHOTOS, SceneRow
from hilsplat.stages import stage_of
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.progress import duration
from hilsplat.workflow.resources import GPU, GUIDED, NODES, PICTURE_S, START_S, JobResources
from hilsplat.workflow.scene_data import of_variant

PROBE_S = 1.0
"""CPU seconds of `start_probe` at which costs need no scaling, chosen by a run of two scenes (620 s)."""

OTHERS = "tables"  # row for jobs without a scene

NOTES = (
    "Hours are scaled by how long Python takes to start here. Memory is that of the largest job.",
    f"GPU: {'measured' if GPU['measured'] else 'estimated, not measured,'} for fits, SAM and CLIP on "
    f"{GPU['card']}; other jobs run on the CPU.",
)

KEPT_PROMPTS = 0.3  # share of the previewed prompts whose masks are decoded


class JobEstimate(NamedTuple):
    """Estimate of one job; `scene` is empty for jobs without a scene."""

    scene: str
    disk_mb: float
    memory_mb: int
    core_s: float
    card_s: float | None  # on a card, or None for jobs of the CPU


class RunEstimate:
    """Jobs of a dry run, by data set."""

    def __init__(self, resources: JobResources) -> None:
        self.resources = resources
        self._probe = start_probe()
        self._jobs = defaultdict[str, list[JobEstimate]](list)
        self._candidates = set[tuple[object, ...]]()

    def add(self, rule: str, wildcards: Mapping[str, str], memory_mb: int) -> None:
        if "scene" not in wildcards:
            self._jobs[OTHERS].append(JobEstimate("", 0.0, memory_mb, START_S, None))
            return
        job = SimpleNamespace(**wildcards)
        scene = f"{job.dataset}/{job.scene}"
        disk_mb, core_s = self.resources.disk_mb(rule, job), self.resources.core_seconds(rule, job)
        card_s, candidates = self.resources.card_seconds(rule, job), self.resources.candidates(rule, job)
        if candidates in self._candidates:  # another variant's job leaves them in the cache
            views = self.resources.size(self.resources.plan.row(job)).views
            core_s, card_s = START_S + PICTURE_S * views, None
        elif candidates is not None:
            self._candidates.add(candidates)
        self._jobs[job.dataset].append(JobEstimate(scene, disk_mb, memory_mb, core_s, card_s))

    def lines(self) -> list[str]:
        """Return the table; empty if nothing would run."""
        if not self._jobs:
            return []
        cores = self.resources.cores or 1
        head = ("", "scenes", "jobs", "disk", "memory", f"hours, {cores} cores", "hours, GPU")
        names, scale = sorted(self._jobs, key=lambda name: (name == OTHERS, name)), machine_scale(self._probe)
        rows = [_row(name, self._jobs[name], cores, scale) for name in names]
        total = _row("all", [job for name in names for job in self._jobs[name]], cores, scale)
        return ["Estimate for this run:", *aligned_table([head, *rows, total], [head[0]]), *NOTES]


def start_probe() -> subprocess.Popen[str]:
    """Start a process that loads libraries and prints its CPU time, beside the planning."""
    code = "import pandas, scipy.sparse, time; print(time.process_time())"
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def machine_scale(probe: subprocess.Popen[str]) -> float:
    """Return the CPU time of a probe on this machine, relative to `PROBE_S`."""
    return float(probe.communicate()[0]) / PROBE_S


def _row(name: str, jobs: Sequence[JobEstimate], cores: int, scale: float) -> tuple[str, ...]:
    scenes = {job.scene for job in jobs if job.scene}
    core_s = scale * sum(job.core_s for job in jobs)
    with_gpu_s = sum(scale * job.core_s / cores if job.card_s is None else job.card_s for job in jobs)
    return (
        name,
        str(len(scenes)) if scenes else "",
        str(len(jobs)),
        f"{sum(job.disk_mb for job in jobs) / 1000:.1f} GB",
        f"{max(job.memory_mb for job in jobs) / 1000:.1f} GB",
        f"{core_s / cores / 3600:.2f}",
        f"{with_gpu_s / 3600:.2f}",
    )


# ---- photographs ---------------------------------------------------------------------------------


def forecasts(plan: Plan, cores: int) -> list[str]:
    """Return a line for each photograph scene that full-size SAM and CLIP models have not yet processed.

    Networks are measured on the CPU, unless their jobs get a card; then their seconds are those of `GPU`.
    """
    resources = JobResources(plan, cores)
    lines = []
    for row in plan.scenes:
        stages = plan.stages(row)
        models = [read_model(Path(section.model)) for section in (stages.masks, stages.clip)]
        full = stages.masks.segmenter == "sam" and all(model and not model.embedded for model in models)
        is_new = row.features is None and not Path(plan.path(row, "default", "clip")).exists()
        if row.group == PHOTOS and full and is_new:
            lines.append(_forecast(plan, resources, row, cores))
    return [*lines, NOTES[1]] if any("the GPU" in line for line in lines) else lines


def _forecast(plan: Plan, resources: JobResources, row: SceneRow, cores: int) -> str:
    from hilsplat.embed.model_check import seconds_of  # onnxruntime is slow to import

    num_photos, stages = resources.size(row).views, plan.stages(row)
    sam, clip, cache = stages.masks, stages.clip, plan.results / ".cache"
    fit_on_card, sam_on_card, clip_on_card = (
        bool(resources.gpus(rule)(row)) for rule in ("gaussians", "masks", "clip")
    )
    measured = {} if sam_on_card else seconds_of(Path(sam.model), sam.variant, sam.precision, cache)

    def photo_s(job: Any, share: float = 1.0) -> float:
        """Return SAM's seconds per photograph: on a card, or on a core with a share of the grid's prompts."""
        masks = plan.stages(job).masks
        if sam_on_card:
            return (resources.card_seconds("masks", job) or 0.0) / (num_photos * masks.key_views)
        prompt_s = measured["masks"]
        if "preview" in measured:
            prompt_s = measured["preview"] + KEPT_PROMPTS * measured["masks"]
        return measured["image"] + PICTURE_S + share * masks.points_per_side**2 * prompt_s

    crop_s = GPU["clip_crop_s"]
    if not clip_on_card:
        crop_s = seconds_of(Path(clip.model), clip.variant, clip.precision, cache)["crop"]
    photos_at_once, crops_at_once = (1 if on_card else cores for on_card in (sam_on_card, clip_on_card))
    every = stages.poses.test_every
    views = num_photos - (num_photos // every if every else 0)
    fit_s = resources.core_seconds("gaussians", row) / cores
    if fit_on_card:
        fit_s = resources.card_seconds("gaussians", row) or 0.0
    before_s = resources.core_seconds("poses", row) / cores + fit_s
    linking = plan.identity("semantic_tree", "default", *plan.situation(row)).stages
    after_s = sum(resources.core_seconds(name, row) for name in linking if stage_of(name).artifact != "masks")
    after_s /= cores
    crops_s = NODES * crop_s / crops_at_once  # for one crop per node
    first_answer, rest_s = "", views * photo_s(row) / photos_at_once
    if plan.first_answer(of_variant(row, "default")):
        key = of_variant(row, KEY_VIEWS)
        settings = plan.stages(key)
        first = views * settings.masks.key_views
        before_s += first * photo_s(key) / photos_at_once + after_s / 2
        before_s += settings.clip.crops_per_node * crops_s
        share = GUIDED if sam.prompts == "guided" else 1.0
        rest_s = (views - first) * photo_s(row, share) / photos_at_once
        first_answer = f"first answer in {duration(before_s)}, "
    total_s = before_s + rest_s + after_s + clip.crops_per_node * crops_s
    core = f"one of {cores} cores"
    return (
        f"{row.name}: {first_answer}all photographs in {duration(total_s)}. "
        f"SAM takes {photo_s(row):.1f} s per photograph on {'the GPU' if sam_on_card else core}, "
        f"and CLIP {crop_s:.2g} s per crop on {'the GPU' if clip_on_card else core}."
    )
