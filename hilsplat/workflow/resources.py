"""What a job asks for: threads, memory, minutes and GPUs, from the size of its scene and its settings.

Memory is a sum of parts that grow with the pixels, the Gaussians and the threads. The constants lie above the
peaks in Snakemake's `benchmark:` records, of scenes from the tiny one to a million Gaussians
(tests/unit/workflow/peak_memory.tsv); models go by `models.memory`. A job that is killed all the same is
tried again with twice as much of everything.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hilsplat.base.errors import ModelError
from hilsplat.scene.sheet import SceneRow
from hilsplat.splat.ply import vertex_count
from hilsplat.workflow.job_times import size_of
from hilsplat.workflow.jobs import Job
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.time_left import Size, first_guess
from hilsplat.workflow.wanted import wanted

MP_PER_THREAD = 2.0
"""Megapixels of all views that keep a thread busy; a job of a small scene gets fewer threads than it may."""

SNAKEMAKE_MB = 700
"""Of the two Snakemakes that a job of a cluster starts before its stage: they count against its limit."""

TIMES_GUESS = 6
"""A job may take this many times its first guess, which is rough (`time_left`), on a slow node."""

LEAST_MINUTES = 10

SHARE_OF_MACHINE = 0.8
"""Of the memory of this machine, for one stage with a model."""


@dataclass(frozen=True)
class Memory:
    """Memory of a stage, in megabytes.

    Attributes:
        base: whatever the scene, libraries included.
        mp: per megapixel of all views.
        capped_mp: the same, up to `cap`.
        cap: most that `capped_mp` comes to.
        view_mp: per megapixel of one view.
        thread_mp: per megapixel of one view and thread.
        thousand: per thousand Gaussians.
    """

    base: int | float
    mp: int | float = 0.0
    capped_mp: int | float = 0.0
    cap: int | float = 0.0
    view_mp: int | float = 0.0
    thread_mp: int | float = 0.0
    thousand: int | float = 0.0

    def of(self, size: Size, gaussians: int, threads: int) -> float:
        """Memory for a scene."""
        total_mp = size.views * size.view_mp
        return (
            self.base
            + self.mp * total_mp
            + min(self.cap, self.capped_mp * total_mp)
            + (self.view_mp + self.thread_mp * threads) * size.view_mp
            + self.thousand * gaussians / 1000
        )


MEMORY = {
    "source": Memory(2000, mp=5),
    "world": Memory(500, thread_mp=800),
    "poses": Memory(550, mp=8, thread_mp=100),
    "gaussians": Memory(500, mp=15, thousand=3),
    "masks": Memory(800, mp=4, view_mp=500),
    "coverage_tree": Memory(300, mp=3),
    "clip": Memory(600, mp=4),
    "contributions": Memory(1000, capped_mp=330, cap=2900, thousand=5.5),
    "semantic_tree": Memory(600, mp=24, thousand=4),
    "autoencoder": Memory(550, mp=15),
    "field": Memory(650, mp=18, thousand=7.5),
    "method": Memory(1000, mp=40, thousand=9),
    "evaluate": Memory(1900, view_mp=1200, thousand=4),
    "figures": Memory(1000, view_mp=1200, thousand=4),
    "mask_truth": Memory(700, view_mp=500),
    "comparison": Memory(1000, view_mp=1200, thousand=4),
    "train_models": Memory(8000),
    "table": Memory(500),
    "sweep_plot": Memory(500),
}
"""Rule -> its memory without models. The constants of `source` and of `train_models` were not measured."""

COMPARED = Memory(450, thousand=4)
"""What `comparison` takes for each method beside the other."""


def scene_threads(plan: Plan, cores: int) -> int:
    """Threads of a job on this machine: one, if there are as many scenes as cores."""
    return max(1, cores // min(len(plan.scenes), cores))


def variant_threads(plan: Plan, cores: int) -> int:
    """Threads of a job of one variant: the fields of a single scene too are solved side by side."""
    fields = sum(str(each.output).endswith("field.safetensors") for each in wanted(plan))
    return max(1, cores // min(max(fields, 1), cores))


class JobResources:
    """Resources of the jobs of a plan, as functions of wildcards that Snakemake calls.

    A job on a cluster computes them again on its node: there they depend on nothing that differs between
    machines.

    Args:
        plan: the plan of the run.
        most_threads: of a job on a cluster (`max-threads` of the profile); None: jobs run on this machine.
    """

    def __init__(self, plan: Plan, most_threads: int | None = None) -> None:
        self.plan = plan
        self._most_threads = most_threads
        self.size = functools.cache(self._size)
        self.gaussians = functools.cache(self._gaussians)
        self._seconds = functools.cache(self._guess)

    def threads(self, wildcards: Job) -> int:
        """Threads of a job on a cluster: those that the scene's pixels keep busy, at most `most_threads`."""
        size = self.size(self.plan.row(wildcards))
        busy = math.ceil(size.views * size.view_mp / MP_PER_THREAD)
        return max(1, min(self._most_threads or 1, busy))

    def memory_mb(self, rule: str) -> Callable[..., int]:
        """Resource `mem_mb` of a rule."""

        def needed(wildcards: Any, threads: int, attempt: int) -> int:
            if hasattr(wildcards, "scene"):
                row = self.plan.row(wildcards)
                mb = MEMORY[rule].of(self.size(row), self.gaussians(row), threads)
                mb = max(mb, self._model_mb(rule, wildcards, threads))
                if rule == "comparison":
                    methods = len(self.plan.run.main_variants)
                    mb += methods * COMPARED.of(self.size(row), self.gaussians(row), threads)
            else:
                mb = float(MEMORY[rule].base)
            more = SNAKEMAKE_MB if self._most_threads else 0
            return _hundreds(mb + more) * 2 ** (attempt - 1)

        return needed

    def minutes(self, rule: str) -> Callable[..., int]:
        """Resource `runtime` of a rule."""

        def needed(wildcards: Any, threads: int, attempt: int) -> int:
            seconds = 0.0
            if hasattr(wildcards, "scene"):
                size = self.size(self.plan.row(wildcards))
                seconds = self._seconds(rule, *self.plan.which(wildcards), size, threads)
            minutes = max(LEAST_MINUTES, TIMES_GUESS * seconds / 60)
            return math.ceil(minutes / 5) * 5 * 2 ** (attempt - 1)

        return needed

    def gpus(self, section: str) -> Callable[[Job], int]:
        """Resource `gpu` of a rule: 1 if its section says `device: cuda`."""
        return lambda wildcards: int(getattr(self.plan.stages(wildcards), section).device == "cuda")

    def _size(self, row: SceneRow) -> Size:
        return size_of(self.plan, row)

    def _gaussians(self, row: SceneRow) -> int:
        """Gaussians of a scene: of the PLY that replaces the fit, or as many as the fit may make."""
        known = vertex_count(row.gaussians) if row.gaussians is not None else None
        job = SimpleNamespace(dataset=row.dataset, scene=row.scene)
        return known or self.plan.stages(job).gaussians.max_gaussians

    def _guess(self, rule: str, variant: str, scopes: tuple[str, ...], size: Size, threads: int) -> float:
        return first_guess(rule, self.plan.stages_of(variant, scopes), size, threads)

    def _model_mb(self, rule: str, wildcards: Job, threads: int) -> int:
        """Memory of a stage that runs a model, with a view per thread, as far as this machine can hold them.

        The stage runs fewer at once if it is given less (`--set-resources masks:mem_mb=...`).
        """
        if rule not in ("masks", "clip"):
            return 0
        settings = getattr(self.plan.stages(wildcards), rule)
        if rule == "masks" and settings.segmenter != "sam":
            return 0
        batch = settings.batch if rule == "clip" else settings.points_per_batch
        here = self._most_threads is None
        return _model_memory_mb(Path(settings.model), settings.variant, batch, threads, here)


@functools.cache
def _model_memory_mb(folder: Path, variant: str, batch: int | str, threads: int, here: bool) -> int:
    """Memory of a stage with a model; 0 if its folder cannot be read, which the stage reports."""
    from hilsplat.models.folder import open_model_folder
    from hilsplat.models.memory import MIB, machine_mib, needs_of  # onnxruntime takes a while to import
    from hilsplat.segment.sam import own_thresholds

    try:
        model = open_model_folder(folder, variant=variant)
        prompts = own_thresholds(model).points_per_batch if isinstance(batch, str) else batch
    except ModelError:
        return 0
    needs = needs_of(model, prompts)
    views = needs.views_at_once(threads, SHARE_OF_MACHINE * machine_mib()) if here else threads
    return round(needs.total_mib(views) * MIB / 1e6)


def _hundreds(mb: int | float) -> int:
    return math.ceil(mb / 100) * 100
