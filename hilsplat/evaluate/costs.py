"""Time and memory of jobs and queries, from the records beside artifacts.

Times and memory differ from run to run, so they are not in `scores.csv`, and tables that show them have the
name suffix `-seconds`. All other files are reproducible byte for byte.
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hilsplat.base.artifacts import parse_json, write_text
from hilsplat.base.errors import ArtifactError, foreign
from hilsplat.base.lineage import artifacts_in, read_provenance, require_as_written, sha256_of_file
from hilsplat.base.ownership import require_beginning
from hilsplat.base.tables import markdown_table, read_csv, write_csv
from hilsplat.configuration import SECTIONS

PREPARATION = ("masks", "coverage_tree", "clip")
TRAINING = ("contributions", "semantic_tree", "autoencoder", "field")
FROM_CACHE = re.compile(r"\bfrom_cache [1-9]")  # in the log of a job that read finished views (`stage_log`)
TIMES = "times.csv"
TIME_COLUMNS = ("dataset", "scene", "variant", "method", "seconds")


@dataclass(frozen=True)
class Job:
    """One finished job. Data set, scene and variant are empty if they don't apply."""

    stage: str
    dataset: str
    scene: str
    variant: str
    elapsed_s: float  # wall-clock time
    cpu_s: float  # of the job and its child processes; 0 if the job was too short to be sampled
    peak_mib: float  # peak resident memory; 0 if the job was too short to be sampled
    is_partial: bool = False  # whether an earlier job computed some of its views, whose time is not included


@dataclass(frozen=True)
class Cost:
    """Cost of one scene under one variant; shared stages are counted in full. Unrecorded values are nan."""

    dataset: str
    scene: str
    variant: str
    prepare_s: float  # wall-clock time of masks, coverage trees and CLIP
    train_s: float  # wall-clock time of contributions, semantic tree, autoencoder and field
    peak_mib: float  # peak resident memory of the training jobs
    query_s: Mapping[str, float]  # per method, seconds from a text to a mask in a view
    unrecorded: tuple[str, ...] = ()  # stages whose times are missing from the results folder
    partial: tuple[str, ...] = ()  # stages whose times don't include views from the cache


def write_times(scores: Path, dataset: str, scene: str, variant: str, seconds: Mapping[str, float]) -> None:
    rows = [[dataset, scene, variant, method, f"{value:.4f}"] for method, value in sorted(seconds.items())]
    write_csv(Path(scores).with_name(TIMES), TIME_COLUMNS, rows)


def read_costs(scores: Iterable[Path]) -> list[Cost]:
    """Return the costs of the scenes and variants in score files, from the records beside the artifacts."""
    costs = []
    for path in scores:
        table = Path(path).with_name(TIMES)
        rows = read_csv(table, TIME_COLUMNS, "run `hilsplat evaluate` again (evaluate-files has no times)")
        require_as_written(table, sha256_of_file(table))
        if not rows:  # a scene without labels
            continue
        jobs = jobs_of(Path(path))
        names = rows[0]["dataset"], rows[0]["scene"], rows[0]["variant"]
        times = _seconds(jobs, PREPARATION), _seconds(jobs, TRAINING)
        training = [jobs[stage] for stage in TRAINING if stage in jobs]
        peak_mib = 0.0 if None in training else max((job.peak_mib for job in training if job), default=0.0)
        query_s = {row["method"]: float(row["seconds"]) for row in rows}
        unrecorded = tuple(stage for stage, job in jobs.items() if job is None)
        partial = tuple(stage for stage, job in jobs.items() if job and job.is_partial)
        costs.append(Cost(*names, *times, peak_mib or math.nan, query_s, unrecorded, partial))
    return costs


def jobs_of(scores: Path) -> dict[str, Job | None]:
    """Map each stage behind a score file to its job, run by any variant, or to None if it has no record.

    The score file's provenance lists the artifacts that `evaluate` read; the field's provenance lists the
    rest. Stages whose output was not read are absent.
    """
    places = _inputs(scores)
    if "field" in places:
        places = {**_inputs(places["field"]), **places}
    jobs: dict[str, Job | None] = {}
    for stage in (*PREPARATION, *TRAINING):
        if stage in places:
            record = places[stage].parent / "benchmarks" / f"{stage}.jsonl"
            jobs[stage] = read_benchmark(record, record.parents[2])[-1] if record.is_file() else None
    return jobs


def _inputs(artifact: Path) -> dict[str, Path]:
    record = read_provenance(artifact)
    return {name: Path(entry.path) for name, entry in record.inputs.items()} if record else {}


def _seconds(jobs: Mapping[str, Job | None], stages: tuple[str, ...]) -> float:
    """Return the wall-clock time of `stages`, s; nan if a job has no record or `jobs` has none of them."""
    needed = [jobs[stage] for stage in stages if stage in jobs]
    if not needed:
        return math.nan
    return sum(job.elapsed_s if job is not None else math.nan for job in needed)


def run_efficiency(results: Path, out: Path) -> str:
    """Write a CSV of all jobs below `results` and, beside it, a Markdown table of stages; return the table.

    A line below the table counts artifacts whose jobs have no record.

    Raises:
        ArtifactError: there is no benchmark file, one is unreadable, or an output path has an unrelated file.
    """
    files = sorted(Path(results).glob("**/benchmarks/*.jsonl"))
    if not files:
        raise ArtifactError(f"{results} contains no benchmark files", fix="run the workflow first")
    jobs = [job for path in files for job in read_benchmark(path, Path(results))]
    stages = list(SECTIONS)  # in the order of the data flow; other stages come after them, by name
    places = {job.stage: stages.index(job.stage) if job.stage in stages else len(stages) for job in jobs}
    jobs.sort(key=lambda job: (places[job.stage], job.stage, job.dataset, job.scene, job.variant))
    columns = ("stage", "dataset", "scene", "variant", "seconds", "cpu_seconds", "peak_mib")
    rows = []
    for job in jobs:
        numbers = (f"{job.elapsed_s:.2f}", f"{job.cpu_s:.2f}", f"{job.peak_mib:.0f}")
        rows.append([job.stage, job.dataset, job.scene, job.variant, *numbers])
    headings = ("stage", "jobs", "mean s", "longest s", "total s", "CPU s", "peak MiB")
    lines = []
    for name in [*dict.fromkeys(job.stage for job in jobs), "all"]:
        of_row = [job for job in jobs if name in (job.stage, "all")]
        times = [job.elapsed_s for job in of_row]
        seconds = (sum(times) / len(times), max(times), sum(times), sum(job.cpu_s for job in of_row))
        peak_mib = f"{max(job.peak_mib for job in of_row):.0f}"
        lines.append([name, len(of_row), *(f"{value:.1f}" for value in seconds), peak_mib])
    text, beside = markdown_table(headings, lines, 1) + "\n", Path(out).with_suffix(".md")
    artifacts = artifacts_in(Path(results))
    if len(artifacts) > len(files):
        missing = f"{len(artifacts) - len(files)} of {len(artifacts)}"
        text += (
            f"\nThe jobs of {missing} artifacts are not in this table: their benchmark files are missing.\n"
        )
    for path, begin in ((Path(out), ",".join(columns)), (beside, text.partition("\n")[0])):
        require_beginning(path, begin)
    write_csv(Path(out), columns, rows)
    write_text(beside, text)
    return text


def read_benchmark(path: Path, results: Path) -> list[Job]:
    """Read the jobs of `<dataset>/<scene>[/<variant>]/benchmarks/<stage>.jsonl`, one per line.

    Raises:
        ArtifactError: there is no line, or one is not a JSON object with a time.
    """
    folders = path.relative_to(results).parts[:-2]
    dataset, scene, variant = (*folders, "", "", "")[:3]
    jobs = list[Job]()
    log = path.parents[1] / "logs" / f"{path.stem}.log"  # of the last job, as the benchmark
    is_partial = log.is_file() and bool(FROM_CACHE.search(log.read_text(encoding="utf-8", errors="replace")))
    with foreign(path, ArtifactError, problem="is not a valid benchmark file", fix="run its stage again"):
        for line in path.read_text(encoding="utf-8").splitlines() or [""]:
            record = parse_json(line)
            sampled = (record.get("cpu_time"), record.get("max_rss"))  # "-" or null if Snakemake couldn't
            cpu_s, peak_mib = (float(v) if isinstance(v, int | float) else 0.0 for v in sampled)
            names = path.stem, dataset, scene, variant
            jobs.append(Job(*names, float(record["s"]), cpu_s, peak_mib, is_partial))
    return jobs
