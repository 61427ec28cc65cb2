"""Table that estimates the time, memory and disk space of a run from the jobs of a dry run."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace

from hilsplat.workflow.resources import START_S, JobResources

GPU_GAIN = {"gaussians": 4, "masks": 27, "clip": 60}
"""Rule -> speed with a GPU relative to one core. Measured for a fit of 100,000 Gaussians
(docs/benchmarks.md), whose loss and Adam stay on the CPU. The others are from published times on an
RTX 3090: SAM ViT-H's generator takes 4 s per picture, CLIP B/16 5 ms per crop. Other rules are assumed to
run on the CPU."""

OTHERS = "tables"
"""Name of the row for jobs without a scene."""


@dataclass
class Totals:
    """Sums over the jobs of a data set."""

    scenes: set[str] = field(default_factory=set)
    jobs: int = 0
    disk_mb: float = 0.0
    memory_mb: int = 0
    core_s: float = 0.0
    gpu_s: float = 0.0
    beside_gpu_s: float = 0.0

    def __add__(self, other: "Totals") -> "Totals":
        return Totals(
            self.scenes | other.scenes,
            self.jobs + other.jobs,
            self.disk_mb + other.disk_mb,
            max(self.memory_mb, other.memory_mb),
            self.core_s + other.core_s,
            self.gpu_s + other.gpu_s,
            self.beside_gpu_s + other.beside_gpu_s,
        )


class RunEstimate:
    """Jobs of a dry run, summed by data set.

    Args:
        resources: estimates of the plan's jobs.
    """

    def __init__(self, resources: JobResources) -> None:
        self.resources = resources
        self._totals = defaultdict[str, Totals](Totals)

    def add(self, rule: str, wildcards: Mapping[str, str], memory_mb: int) -> None:
        """Add a job to the totals of its data set."""
        job = SimpleNamespace(**wildcards)
        of_scene = "scene" in wildcards
        core_s = self.resources.core_seconds(rule, job) if of_scene else START_S
        gain = GPU_GAIN.get(rule, 0)
        found = Totals(
            {f"{job.dataset}/{job.scene}"} if of_scene else set(),
            1,
            self.resources.disk_mb(rule, job) if of_scene else 0.0,
            memory_mb,
            core_s,
            core_s / gain if gain else 0.0,
            0.0 if gain else core_s,
        )
        name = self.resources.plan.row(job).dataset if of_scene else OTHERS
        self._totals[name] = self._totals[name] + found

    def lines(self) -> list[str]:
        """Return the table; empty if nothing would run."""
        if not self._totals:
            return []
        total, cores = sum(self._totals.values(), Totals()), self.resources.cores or 1
        rows: list[tuple[str, ...]] = [
            ("", "scenes", "jobs", "disk", "memory", f"hours, {cores} cores", "hours, GPU")
        ]
        rows += [
            (name, *_cells(found, cores))
            for name, found in sorted(self._totals.items(), key=lambda each: (each[0] == OTHERS, each[0]))
        ]
        rows.append(("all", *_cells(total, cores)))
        return ["This run would take about:", *_aligned(rows), *NOTES]


NOTES = (
    "Hours can be wrong by a factor of two on another machine. Memory is that of the largest job.",
    "GPU: published times of a 24 GB card for fits, SAM and CLIP; the cores do the rest.",
)


def _cells(found: Totals, cores: int) -> tuple[str, ...]:
    gpu = found.gpu_s + found.beside_gpu_s / cores
    return (
        str(len(found.scenes)) if found.scenes else "",
        str(found.jobs),
        f"{found.disk_mb / 1000:.1f} GB",
        f"{found.memory_mb / 1000:.1f} GB",
        *(f"{seconds / 3600:.2f}" for seconds in (found.core_s / cores, gpu)),
    )


def _aligned(rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *others in rows:
        cells = [value.rjust(width) for value, width in zip(others, widths[1:], strict=True)]
        yield "  ".join([first.ljust(widths[0]), *cells]).rstrip()
