"""Table that estimates the time, memory and disk space of a run from the jobs of a dry run."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import NamedTuple

from hilsplat.workflow.resources import START_S, JobResources

GPU_GAIN = {"gaussians": 4, "masks": 27, "clip": 60}
"""Rule -> speed with a GPU relative to one core. Measured for a fit of 100,000 Gaussians
(docs/benchmarks.md), whose loss and Adam stay on the CPU. The others are from published times on an
RTX 3090: SAM ViT-H's generator takes 4 s per picture, CLIP B/16 5 ms per crop. Other rules are assumed to
run on the CPU."""

OTHERS = "tables"
"""Name of the row for jobs without a scene."""

NOTES = (
    "Hours can be wrong by a factor of two on another machine. Memory is that of the largest job.",
    "GPU: published times of a 24 GB card for fits, SAM and CLIP; the cores do the rest.",
)


class JobEstimate(NamedTuple):
    """Estimate of one job; `scene` is empty for jobs without a scene."""

    scene: str
    disk_mb: float
    memory_mb: int
    core_s: float
    gpu_gain: int


class RunEstimate:
    """Jobs of a dry run, by data set."""

    def __init__(self, resources: JobResources) -> None:
        self.resources = resources
        self._jobs = defaultdict[str, list[JobEstimate]](list)

    def add(self, rule: str, wildcards: Mapping[str, str], memory_mb: int) -> None:
        """Add a job to its data set."""
        gain = GPU_GAIN.get(rule, 0)
        if "scene" not in wildcards:
            self._jobs[OTHERS].append(JobEstimate("", 0.0, memory_mb, START_S, gain))
            return
        job = SimpleNamespace(**wildcards)
        scene = f"{job.dataset}/{job.scene}"
        disk_mb, core_s = self.resources.disk_mb(rule, job), self.resources.core_seconds(rule, job)
        self._jobs[job.dataset].append(JobEstimate(scene, disk_mb, memory_mb, core_s, gain))

    def lines(self) -> list[str]:
        """Return the table; empty if nothing would run."""
        if not self._jobs:
            return []
        cores = self.resources.cores or 1
        rows: list[tuple[str, ...]] = []
        rows.append(("", "scenes", "jobs", "disk", "memory", f"hours, {cores} cores", "hours, GPU"))
        for name, jobs in sorted(self._jobs.items(), key=lambda each: (each[0] == OTHERS, each[0])):
            rows.append(_row(name, jobs, cores))
        rows.append(_row("all", [job for jobs in self._jobs.values() for job in jobs], cores))
        return ["This run would take about:", *_aligned(rows), *NOTES]


def _row(name: str, jobs: Sequence[JobEstimate], cores: int) -> tuple[str, ...]:
    scenes = {job.scene for job in jobs if job.scene}
    core_s = sum(job.core_s for job in jobs)
    with_gpu_s = sum(job.core_s / (job.gpu_gain or cores) for job in jobs)
    return (
        name,
        str(len(scenes)) if scenes else "",
        str(len(jobs)),
        f"{sum(job.disk_mb for job in jobs) / 1000:.1f} GB",
        f"{max(job.memory_mb for job in jobs) / 1000:.1f} GB",
        f"{core_s / cores / 3600:.2f}",
        f"{with_gpu_s / 3600:.2f}",
    )


def _aligned(rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *others in rows:
        cells = [value.rjust(width) for value, width in zip(others, widths[1:], strict=True)]
        yield "  ".join([first.ljust(widths[0]), *cells]).rstrip()
