"""Time per stage: Snakemake's benchmark files as a table.

Times differ from run to run, so this table is separate from those that must be reproducible.
"""

from dataclasses import dataclass
from pathlib import Path

from hilsplat.base.artifacts import parse_json, write_text
from hilsplat.base.errors import ArtifactError
from hilsplat.base.provenance import require_beginning
from hilsplat.base.tables import write_csv
from hilsplat.configuration import SECTIONS


@dataclass(frozen=True)
class Job:
    """One finished job.

    Attributes:
        stage: its rule.
        dataset: empty for a job without a scene, such as a table.
        scene: empty for a job without a scene.
        variant: empty if all variants share the stage.
        elapsed_s: wall-clock time, s.
        cpu_s: CPU time of the job and its children, s; 0 if the job was too short to be sampled.
        peak_mib: largest resident memory, MiB; 0 if the job was too short to be sampled.
    """

    stage: str
    dataset: str
    scene: str
    variant: str
    elapsed_s: float
    cpu_s: float
    peak_mib: float


def run_efficiency(results: Path, out: Path) -> str:
    """Collect every benchmark file below `results`; write a CSV of jobs.

    A Markdown table of stages is written beside it and returned.

    Raises:
        ArtifactError: there is no benchmark file, one is unreadable, or an output is an unrelated file.
    """
    files = sorted(Path(results).glob("**/benchmarks/*.jsonl"))
    if not files:
        raise ArtifactError(f"{results} contains no benchmark files", fix="run the workflow first")
    jobs = [job for path in files for job in read_benchmark(path, Path(results))]
    jobs.sort(key=lambda job: (_order(job.stage), job.dataset, job.scene, job.variant))
    text = stage_table(jobs)
    columns = ("stage", "dataset", "scene", "variant", "seconds", "cpu_seconds", "peak_mib")
    rows = [
        [
            *(job.stage, job.dataset, job.scene, job.variant),
            *(f"{job.elapsed_s:.2f}", f"{job.cpu_s:.2f}", f"{job.peak_mib:.0f}"),
        ]
        for job in jobs
    ]
    beside = Path(out).with_suffix(".md")
    for path, begin in ((Path(out), ",".join(columns)), (beside, text.partition("\n")[0])):
        require_beginning(path, begin)
    write_csv(Path(out), columns, rows)
    write_text(beside, text)
    return text


def read_benchmark(path: Path, results: Path) -> list[Job]:
    """Read the jobs of `<dataset>/<scene>[/<variant>]/benchmarks/<stage>.jsonl`, one per line.

    Raises:
        ArtifactError: a line is not a JSON object with a time.
    """
    place = path.relative_to(results).parts[:-2]
    dataset, scene, variant = (*place, "", "", "")[:3]
    jobs = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            record = parse_json(line)
            elapsed_s = float(record["s"])
        except (ValueError, KeyError, TypeError) as error:
            raise ArtifactError(
                f"{path} is not a valid benchmark file: {error}", fix="run its stage again"
            ) from error
        cpu_s, peak_mib = _number(record.get("cpu_time")), _number(record.get("max_rss"))
        jobs.append(Job(path.stem, dataset, scene, variant, elapsed_s, cpu_s, peak_mib))
    return jobs


def stage_table(jobs: list[Job]) -> str:
    """Return a Markdown table with number of jobs, times, CPU and peak memory per stage."""
    of_stage: dict[str, list[Job]] = {}
    for job in jobs:
        of_stage.setdefault(job.stage, []).append(job)
    lines = [
        "| stage | jobs | mean s | longest s | total s | CPU s | peak MiB |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for stage in sorted(of_stage, key=_order):
        lines.append(_line(stage, of_stage[stage]))
    lines.append(_line("all", jobs))
    return "\n".join(lines) + "\n"


def _line(name: str, jobs: list[Job]) -> str:
    times = [job.elapsed_s for job in jobs]
    cells = [
        name,
        str(len(jobs)),
        f"{sum(times) / len(times):.1f}",
        f"{max(times):.1f}",
        f"{sum(times):.1f}",
        f"{sum(job.cpu_s for job in jobs):.1f}",
        f"{max(job.peak_mib for job in jobs):.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


def _order(stage: str) -> tuple[int, str]:
    """Return the sort key of a stage: in the order of the settings (the data flow), others after by name."""
    stages = tuple(SECTIONS)
    return (stages.index(stage) if stage in stages else len(stages), stage)


def _number(value: object) -> float:
    """Return a number; Snakemake writes "-" or null for values that it could not sample."""
    return float(value) if isinstance(value, int | float) else 0.0
