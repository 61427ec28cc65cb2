"""Estimates for the user: the jobs of a dry run, and the time until photographs can be queried."""

import subprocess
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

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
    """Return a line for each photograph scene that full-size SAM and CLIP models have not yet processed."""
    resources = JobResources(plan)
    lines = []
    for row in plan.scenes:
        stages = plan.stages(row)
        models = [read_model(Path(section.model)) for section in (stages.masks, stages.clip)]
        full = stages.masks.segmenter == "sam" and all(model and not model.embedded for model in models)
        if row.group == PHOTOS and full and not Path(plan.path(row, "default", "clip")).exists():
            lines.append(_forecast(plan, resources, row, cores))
    return lines


def _forecast(plan: Plan, resources: JobResources, row: SceneRow, cores: int) -> str:
    from hilsplat.embed.model_check import seconds_of  # onnxruntime is slow to import

    num_photos, stages = resources.size(row).views, plan.stages(row)
    sam, clip, cache = stages.masks, stages.clip, plan.results / ".cache"
    view_s = seconds_of(Path(sam.model), sam.variant, sam.precision, cache)
    crop_s = seconds_of(Path(clip.model), clip.variant, clip.precision, cache)["crop"]
    prompt_s = view_s["masks"]
    if "preview" in view_s:
        prompt_s = view_s["preview"] + KEPT_PROMPTS * view_s["masks"]
    every = stages.poses.test_every
    views = num_photos - (num_photos // every if every else 0)
    prompts = stages.masks.points_per_side**2
    base_s = view_s["image"] + PICTURE_S
    full_s, guided_s = base_s + prompts * prompt_s, base_s + GUIDED * prompts * prompt_s
    before_s = sum(resources.core_seconds(rule, row) for rule in ("poses", "gaussians"))
    linking = plan.identity("semantic_tree", "default", *plan.situation(row)).stages
    after_s = sum(resources.core_seconds(name, row) for name in linking if stage_of(name).artifact != "masks")
    first_answer, rest_s = "", views * full_s
    if plan.first_answer(of_variant(row, "default")):
        settings = plan.stages(of_variant(row, KEY_VIEWS))
        first = views * settings.masks.key_views
        key_s = base_s + settings.masks.points_per_side**2 * prompt_s
        before_s += first * key_s + after_s / 2 + NODES * settings.clip.crops_per_node * crop_s
        rest_s = (views - first) * (guided_s if stages.masks.prompts == "guided" else full_s)
        first_answer = f"first answer in {duration(before_s / cores)}, "
    total_s = before_s + rest_s + after_s + NODES * stages.clip.crops_per_node * crop_s
    return (
        f"{row.name}: {first_answer}all photographs in {duration(total_s / cores)}. "
        f"On one of {cores} cores, SAM takes {full_s:.0f} s per photograph, and CLIP {crop_s:.2f} s per crop."
    )
