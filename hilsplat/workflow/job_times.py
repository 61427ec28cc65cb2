"""The jobs of a run with their first guesses and what earlier runs measured of them."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import SimpleNamespace

from PIL import Image

from hilsplat.scene.sheet import SceneRow
from hilsplat.workflow.jobs import scene_path
from hilsplat.workflow.plan import Plan, scopes_of
from hilsplat.workflow.time_left import (
    START_S,
    PlannedJob,
    Size,
    finished_size,
    first_guess,
    measured_seconds,
)

UNKNOWN_MP = 0.5
"""Of a view, if no image's header can be read before the run, such as in a data set's archive."""


def planned_job(
    plan: Plan,
    number: int,
    rule: str,
    wildcards: Mapping[str, str],
    *,
    threads: int,
    priority: int = 0,
    after: Iterable[int] = (),
    benchmark: str | None = None,
    log: str | None = None,
) -> PlannedJob:
    """A job of a run, with its first guess.

    Args:
        plan: the plan of the run.
        number: Snakemake's number of the job.
        rule: name of its rule.
        wildcards: their values by name.
        threads: cores that it takes.
        priority: of its rule.
        after: numbers of the jobs that it waits for.
        benchmark: where Snakemake writes its seconds.
        log: its log.
    """
    scene, guess_s = "", START_S
    if "scene" in wildcards:
        job = SimpleNamespace(**wildcards)
        row = plan.row(job)
        scene, guess_s = row.name, first_guess(rule, plan.stages(job), size_of(plan, row), threads)
    return PlannedJob(
        number,
        rule,
        scene,
        wildcards.get("variant", ""),
        threads,
        frozenset(after),
        priority,
        guess_s,
        measured_seconds(Path(benchmark)) if benchmark else None,
        Path(log) if log else None,
    )


def size_of(plan: Plan, row: SceneRow) -> Size:
    """Size of a scene: as its poses say, else as its settings or the headers of its images do."""
    job = SimpleNamespace(dataset=row.dataset, scene=row.scene)
    known = finished_size(Path(scene_path(job, "scene")))
    if known is not None:
        return known
    stages = plan.stages(job)
    if row.world:
        return Size(stages.world.views, stages.world.image_px**2 / 1e6)
    files = plan.data.image_files(job)
    images = plan.data.source_files(job) if isinstance(files, str) else files
    return Size(len(images), _first_mp(images, stages.poses.max_side_px))


def _first_mp(images: Iterable[str], max_side_px: int) -> float:
    """Megapixels of the first image whose header can be read, shrunk as `poses` will shrink it."""
    for image in images:
        try:
            with Image.open(image) as opened:
                width, height = opened.size
        except OSError:  # labels, sheets and other files beside the images
            continue
        return width * height * min(1.0, max_side_px / max(width, height)) ** 2 / 1e6
    return UNKNOWN_MP


def earlier_ratios(plan: Plan, threads: int) -> dict[str, list[float]]:
    """Measured to guessed seconds of every job of the sheet's scenes that an earlier run measured, by rule.

    Args:
        plan: the plan of the run.
        threads: of a job; an earlier run is taken to have had as many.
    """
    ratios: dict[str, list[float]] = {}
    variants = set(plan.run.every_variant())
    for row in plan.rows:
        folder = Path(scene_path(SimpleNamespace(dataset=row.dataset, scene=row.scene)))
        size = finished_size(folder / "scene")
        if size is None:
            continue
        for file in sorted([*folder.glob("benchmarks/*.jsonl"), *folder.glob("*/benchmarks/*.jsonl")]):
            seconds, variant = measured_seconds(file), file.parts[len(folder.parts)]
            if seconds is not None and variant in {"benchmarks", *variants}:
                named = variant if variant in variants else "default"
                stages = plan.run.stages(named, scopes_of(row)).with_models()
                ratios.setdefault(file.stem, []).append(
                    seconds / first_guess(file.stem, stages, size, threads)
                )
    return ratios
