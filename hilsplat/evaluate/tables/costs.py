"""Cost of a scene and variant: time and memory of its jobs, seconds per query.

Times differ from run to run and are stored apart from `scores.csv`, which must be reproducible byte for byte.
"""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hilsplat.base.provenance import read_provenance
from hilsplat.base.tables import read_csv, write_csv
from hilsplat.evaluate.tables.efficiency import Job, read_benchmark

if TYPE_CHECKING:
    from hilsplat.query.language_scene import LanguageScene

PREPARATION = ("masks", "coverage_tree", "clip")
TRAINING = ("contributions", "semantic_tree", "autoencoder", "field")
TIMES = "times.csv"
TIME_COLUMNS = ("dataset", "scene", "variant", "method", "seconds")


@dataclass(frozen=True)
class Cost:
    """Cost of one scene under one variant; shared stages are counted in full.

    Attributes:
        prepare_s: wall-clock time of masks, trees of the views and CLIP, s; nan if a job has no record.
        train_s: wall-clock time of contributions, semantic tree, autoencoder and field, s; nan as above.
        peak_mib: largest resident memory of a training job, MiB; nan without a record.
        query_s: per method, seconds from a text to a mask in a view.
    """

    dataset: str
    scene: str
    variant: str
    prepare_s: float
    train_s: float
    peak_mib: float
    query_s: Mapping[str, float]


def time_queries(
    answers: "LanguageScene", asks: Mapping[str, Callable[[str], object]], view: str, texts: Sequence[str]
) -> dict[str, float]:
    """Return the seconds of one query per method: text, weights of the view, relevancy and mask.

    The view's weights and the text's vector are timed once and added, because later queries reuse them.

    Args:
        asks: per method, a function from a text to its mask in `view`, with weights and vectors cached.
        texts: texts whose vectors are cached; the result is the median over them.
    """
    start = time.perf_counter()
    answers.encode_texts([texts[0]])
    answers.pixel_weights(view)
    shared_s = time.perf_counter() - start
    seconds = {}
    for method, ask in asks.items():
        ask(texts[0])  # compiles and fills caches
        taken = []
        for text in texts:
            start = time.perf_counter()
            ask(text)
            taken.append(time.perf_counter() - start)
        seconds[method] = shared_s + sorted(taken)[len(taken) // 2]
    return seconds


def write_times(scores: Path, dataset: str, scene: str, variant: str, seconds: Mapping[str, float]) -> None:
    """Write `times.csv` beside a score file."""
    rows = [[dataset, scene, variant, method, f"{value:.4f}"] for method, value in sorted(seconds.items())]
    write_csv(Path(scores).with_name(TIMES), TIME_COLUMNS, rows)


def read_costs(scores: Iterable[Path]) -> list[Cost]:
    """Return the costs of the scenes and variants of score files, from the records beside their artifacts.

    Raises:
        ArtifactError: a score file has no times, or a record cannot be read.
    """
    found = []
    for path in scores:
        rows = read_csv(Path(path).with_name(TIMES), TIME_COLUMNS, "run the evaluate stage again")
        if not rows:  # a scene without labels
            continue
        jobs = jobs_of(Path(path))
        first = rows[0]
        found.append(
            Cost(
                first["dataset"],
                first["scene"],
                first["variant"],
                _seconds(jobs, PREPARATION),
                _seconds(jobs, TRAINING),
                _peak(jobs),
                {row["method"]: float(row["seconds"]) for row in rows},
            )
        )
    return found


def jobs_of(scores: Path) -> dict[str, Job | None]:
    """Return the jobs behind a score file by stage, of whichever variant ran them; None without a record.

    The score file's provenance lists the artifacts that `evaluate` read; the field's provenance lists the
    rest. A stage whose output nothing read is absent, such as trees for a baseline.
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
    """Return the wall-clock time of the needed stages, s; nan if one has no record or none is known."""
    needed = [jobs[stage] for stage in stages if stage in jobs]
    if not needed:
        return math.nan
    return sum(job.elapsed_s if job is not None else math.nan for job in needed)


def _peak(jobs: Mapping[str, Job | None]) -> float:
    peaks = [job.peak_mib for stage in TRAINING if (job := jobs.get(stage)) is not None]
    return max(peaks) if peaks and max(peaks) > 0 else math.nan
