"""How long the jobs of a run take: a first guess from the size of the work, corrected by what was measured.

The guess is seconds on one core per megapixel of all views, measured on the benchmark scenes (40 views of
384 x 384 px); the fit goes by its steps instead, and models go by view. It is right within a factor of two or
three on other machines and scenes. What corrects it, and counts more, is the ratio of measured to guessed
seconds: of the same job in an earlier run, else of the same rule (this run or earlier ones), else of all jobs
of this run; and, once a job tells how far it is, its own pace.
"""

import heapq
import json
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import numpy as np

from hilsplat.configuration import StageSettings
from hilsplat.models.store import read_model

START_S = 2.0
"""Of every job: Python, libraries, reading."""

CORE_S_PER_MP = {
    "source": 0.5,
    "world": 7.5,
    "poses": 8.0,
    "coverage_tree": 0.2,
    "contributions": 3.0,
    "semantic_tree": 0.6,
    "autoencoder": 0.4,
    "field": 1.5,
    "method": 4.0,
    "evaluate": 1.5,
    "figures": 1.7,
    "mask_truth": 1.5,
    "comparison": 5.0,
}
"""Rule -> seconds of one core per megapixel of all views. Rules that are missing take `START_S`."""

FIT_S_PER_MP = 0.18
"""Seconds of one core for a step of the fit, per megapixel of a view: the mean of coarse and fine steps."""

GRAPH_S_PER_MP = 4.0
TINY_S_PER_VIEW = {"masks": 2.5, "clip": 0.2}
REAL_S_PER_VIEW = {"masks": 76.0, "clip": 87.0}
"""Seconds of one core: the graph segmenter, the embedded models, SAM ViT-B and CLIP B/16 (docs/models.md)."""

LOOPS = {
    "world": "rendered views",
    "gaussians": "fit steps",
    "masks": "masks of views",
    "clip": "CLIP of views",
    "contributions": "contributions of views",
    "evaluate": "views scored",
    "comparison": "queries compared",
}
"""Rule -> the loop (`base.progress.track`) that is nearly all of its time, so that its share is the job's."""

TRUSTED_SHARE = 0.2
"""From this share on, a job's own pace alone tells how long it takes; before it, it is blended in."""


@dataclass(frozen=True)
class Size:
    """How much a scene has to look at.

    Attributes:
        views: number of views.
        view_mp: megapixels of a view.
    """

    views: int
    view_mp: float


@dataclass(frozen=True)
class PlannedJob:
    """A job of the run.

    Attributes:
        id: Snakemake's number.
        rule: its name.
        scene: dataset/scene; empty for tables.
        variant: empty if the rule has none.
        threads: cores that it takes.
        after: the jobs that it waits for.
        priority: of the jobs that could start, the highest starts first.
        guess_s: `first_guess` of the job.
        measured_s: its seconds in an earlier run, if there was one.
        log: its log, beside which it tells its share.
    """

    id: int
    rule: str
    scene: str
    variant: str
    threads: int
    after: frozenset[int]
    priority: int
    guess_s: float
    measured_s: float | None = None
    log: Path | None = None

    @property
    def name(self) -> str:
        """For people: scene, variant if it is not the default one, and stage."""
        variant = "" if self.variant == "default" else self.variant
        return " ".join(word for word in (self.scene, variant, self.rule.replace("_", " ")) if word)


def first_guess(rule: str, stages: StageSettings, size: Size, threads: int) -> float:
    """Seconds of a job, from the size of its scene and its settings."""
    total_mp = size.views * size.view_mp
    if rule == "gaussians":
        fit = stages.gaussians
        steps = min(fit.iterations, fit.steps_per_view * size.views)
        core_s = FIT_S_PER_MP * steps * size.view_mp * fit.image_scale**2
    elif rule == "masks" and stages.masks.segmenter == "graph":
        core_s = GRAPH_S_PER_MP * total_mp
    elif rule in TINY_S_PER_VIEW:
        model = read_model(Path(getattr(stages, rule).model))
        tiny = model is None or model.embedded
        core_s = size.views * (TINY_S_PER_VIEW if tiny else REAL_S_PER_VIEW)[rule]
    else:
        core_s = CORE_S_PER_MP.get(rule, 0.0) * total_mp
    return START_S + core_s / threads


def measured_seconds(benchmark: Path) -> float | None:
    """Seconds of an earlier run of a job, from Snakemake's benchmark file; None: there is none."""
    try:
        return float(json.loads(benchmark.read_text(encoding="utf-8").splitlines()[-1])["s"])
    except (OSError, ValueError, KeyError, IndexError):  # none yet, or its writing was cut short
        return None


@dataclass
class Pace:
    """How long jobs take beside what was thought.

    Attributes:
        earlier: ratios of measured to guessed seconds in earlier runs, by rule.
        now: the same of this run.
        drift: seconds in this run to those of the same job in an earlier one: the machine may be busier now.
    """

    earlier: Mapping[str, Collection[float]] = field(default_factory=dict)
    now: dict[str, list[float]] = field(default_factory=dict)
    drift: list[float] = field(default_factory=list)

    def seconds(self, job: PlannedJob) -> float:
        """The best estimate of a job that has not begun."""
        if job.measured_s is not None:
            return job.measured_s * median([1.0, *self.drift])
        own = [*self.earlier.get(job.rule, ()), *self.now.get(job.rule, ())]
        everything = [1.0, *(ratio for ratios in self.now.values() for ratio in ratios)]
        return job.guess_s * median(own or everything)

    def learn(self, job: PlannedJob, seconds: float) -> None:
        """A job of this run has ended."""
        self.now.setdefault(job.rule, []).append(seconds / job.guess_s)
        if job.measured_s:
            self.drift.append(seconds / job.measured_s)


def left_of_running(estimate_s: float, elapsed_s: float, share: float) -> float:
    """Seconds that a running job still takes.

    Args:
        estimate_s: what it was thought to take.
        elapsed_s: since it began.
        share: of its main loop that is done; 0: it does not tell.
    """
    trust = min(1.0, share / TRUSTED_SHARE)
    whole = (1 - trust) * estimate_s + (trust * elapsed_s / share if share else 0.0)
    return max(whole - elapsed_s, 0.1 * elapsed_s * (1 - share))  # later than thought: never "done"


def time_left(
    waiting: Iterable[PlannedJob],
    running: Mapping[int, tuple[int, float]],
    seconds: Callable[[PlannedJob], float],
    cores: int,
) -> float:
    """Seconds until all jobs are done, by playing the run through: the order of jobs counts, not their sum.

    Args:
        waiting: jobs that have not begun; jobs that they wait for and that are neither waiting nor running
            are done.
        running: number of a job -> its threads and the seconds that it still takes.
        seconds: estimate of a waiting job.
        cores: cores of the run.
    """
    todo = {job.id: job for job in waiting}
    ends = [(left, job, threads) for job, (threads, left) in running.items()]
    heapq.heapify(ends)
    free, now = cores - sum(threads for _, _, threads in ends), 0.0
    unfinished = {*todo, *running}
    missing = {job.id: set(job.after & unfinished) for job in todo.values()}
    while todo or ends:
        ready = [job for job in todo.values() if not missing[job.id]]
        for job in sorted(ready, key=lambda job: (-job.priority, job.id)):
            threads = min(job.threads, cores)
            if threads <= free or not ends:
                heapq.heappush(ends, (now + seconds(job), job.id, threads))
                free -= threads
                del todo[job.id]
        if not ends:  # only jobs that wait for something that never comes
            break
        now, ended, threads = heapq.heappop(ends)
        free += threads
        for others in missing.values():
            others.discard(ended)
    return now


def finished_size(scene: Path) -> Size | None:
    """Size of a scene whose poses are known, from its folder; None: they are not."""
    try:
        with np.load(scene / "cameras.npz") as cameras:
            sizes = cameras["size_hw"].astype(np.float64)
    except (OSError, ValueError, KeyError):  # not yet, or being written
        return None
    return Size(len(sizes), float(sizes.prod(axis=1).mean()) / 1e6)


def duration(seconds: float) -> str:
    """Seconds as people say them, no more exact than an estimate is."""
    if seconds < 10:
        return "less than 10 s"
    if seconds < 55:
        return f"about {round(seconds, -1):.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"about {max(minutes, 1)} min"
    hours, rest = divmod(round(minutes, -1), 60)
    return f"about {hours} h {rest} min" if rest else f"about {hours} h"
