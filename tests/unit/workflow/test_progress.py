"""The progress of a run: a line per stage, a last line on a terminal, the time left."""

import io
import json
import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilsplat.base.artifacts import write_index
from hilsplat.base.progress import LOG_FORMAT
from hilsplat.stages import all_stages, stage_of
from hilsplat.workflow import progress
from hilsplat.workflow.resources import JobResources
from tests.unit.workflow.plans import BENCHMARK, plan_of

ROOT = Path(__file__).resolve().parents[3]
JOBS = {"gaussians": 1, "semantic_tree": 1, "field": 1, "all": 1, "total": 4}
SECONDS = {"gaussians": 600.0, "semantic_tree": 120.0, "field": 120.0}


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


class FixedResources:
    """Estimates that depend only on the rule."""

    plan = SimpleNamespace(rows=(), scenes=(SimpleNamespace(dataset="photos", scene="desk"),))

    def core_seconds(self, rule: str, job: object) -> float:
        return SECONDS.get(rule, 10.0)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def run(clock, monkeypatch) -> progress.RunProgress:
    """A run of three jobs of two threads each, on two cores."""
    estimates = progress.Estimates()
    estimates.resources = FixedResources()
    monkeypatch.setattr(progress, "estimates", estimates)
    found = progress.RunProgress(clock)
    found.cores = 2
    return found


class Screen:
    """The display of a run, and its output."""

    def __init__(self, run: progress.RunProgress, stream: io.StringIO) -> None:
        self.stream = stream
        self.display = progress.ProgressDisplay(stream, logging.Formatter().format, run)

    def tell(self, event: str = "", text: str = "a block", level: int = 20, **more: object) -> None:
        record = logging.LogRecord("snakemake", level, more.pop("path", __file__), 1, text, None, None)
        record.__dict__.update(more, **({"event": event} if event else {}))
        self.display.show(record)

    def start(self, number: int, rule: str, log: Path | None = None, variant: str = "default") -> None:
        wildcards = {"dataset": "photos", "scene": "desk", "variant": variant}
        logs = [str(log)] if log else []
        self.tell("job_info", jobid=number, rule_name=rule, wildcards=wildcards, threads=2, log=logs)

    def end(self, number: int) -> None:
        self.tell("job_finished", job_id=number)

    @property
    def text(self) -> str:
        """The output so far."""
        return self.stream.getvalue()


@pytest.fixture
def screen(run) -> Screen:
    return Screen(run, io.StringIO())


def test_in_a_file_a_finished_stage_is_one_plain_line(screen, clock):
    screen.tell("run_info", "Job stats", stats=JOBS)
    screen.tell("job_started", jobs=[1])
    for text in ("Building DAG of jobs...", "Using shell: /usr/bin/bash", "Select jobs to execute..."):
        screen.tell(text=text)
    screen.tell(text="a line of ours", path="/project/Snakefile")
    screen.start(1, "gaussians")
    clock.now = 290.0
    screen.end(1)
    screen.tell("progress", done=1, total=3)
    screen.start(2, "field")
    screen.start(0, "all")  # a target, not a job
    screen.end(0)
    screen.display.close()
    line = "photos/desk gaussians: 290 s (1 of 3 done, about 2 min left)"
    assert screen.text == f"a line of ours\n{line}\n"


def test_a_run_without_jobs_says_so(screen):
    screen.tell(text="Nothing to be done (all requested files are present and up to date).")
    assert screen.text.startswith("Nothing to be done")


def test_texts_from_logs_and_jobs_cannot_control_the_terminal(run, tmp_path):
    log = tmp_path / "gaussians.log"
    log_lines(
        log,
        (logging.WARNING, "hilsplat", "image \x1b]0;x\x07"),
        (20, "hilsplat.base.progress", "\x1b[2J: 1 of 3"),
    )
    lines = Screen(run, io.StringIO())
    lines.tell(text="job \x9b31m failed", level=logging.ERROR)
    lines.start(1, "gaussians", log)
    terminal = Screen(run, Terminal())
    terminal.display.show(logging.makeLogRecord({"event": "progress", "msg": "", "levelno": 20}))
    terminal.display.close()
    assert "\\x1b[2J 1 of 3" in terminal.text and "\x1b[2J:" not in terminal.text
    lines.end(1)
    assert lines.text.startswith("job \\x9b31m failed\nimage \\x1b]0;x\\x07\n")


@pytest.mark.parametrize(
    "order", [("semantic_tree", "clip"), ("clip", "feature_tree"), ("semantic_tree", "imported_clip")]
)
def test_the_query_commands_are_printed_once_tree_and_vectors_exist(screen, tmp_path, order, monkeypatch):
    monkeypatch.chdir(tmp_path)
    variant = Path("results/photos/desk/default")
    for number, rule in enumerate((*order, *order)):
        write_index(variant / stage_of(rule).file, {})
        screen.start(2, rule, variant / f"logs/{rule}.log")
        screen.end(2)
        assert ("ready" in screen.text) == (number > 0)
    assert screen.text.count("photos/desk is ready to query:") == 1
    assert screen.text.count('hilsplat query photos/desk "..."') == 1


def test_commands_name_the_path_of_a_scene_outside_results(screen, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    variant = Path("elsewhere/photos/desk/default")
    for rule in ("clip", "semantic_tree"):
        write_index(variant / rule, {})
    screen.start(2, "clip", variant / "logs/clip.log")
    screen.end(2)
    assert "  hilsplat view elsewhere/photos/desk" in screen.text.splitlines()


def test_queries_of_key_views_are_announced_before_those_of_all_views(screen, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = Path("results/photos/desk")
    write_index(scene / "scene", {name: {"split": "test" if name == "c" else "train"} for name in "abc"})
    write_index(scene / "key-views/masks", {"a": {}})
    for number, variant in enumerate(("key-views", "default")):
        write_index(scene / variant / "semantic_tree", {})
        screen.start(number, "clip", scene / variant / "logs/clip.log", variant)
        screen.end(number)
    lines = screen.text.splitlines()
    assert lines[1:5] == [
        "photos/desk is ready to query:",
        "photos/desk uses 1 of 2 photographs until the run ends",
        '  hilsplat query photos/desk "..."',
        "  hilsplat view photos/desk",
    ]
    assert lines[6:] == ["photos/desk uses all photographs"]


def test_errors_of_failed_jobs_are_the_last_lines_with_their_fix_and_a_retry_counts_once(
    screen, run, tmp_path
):
    first, second = tmp_path / "gaussians.log", tmp_path / "field.log"
    error = "SceneError: no view\n  fix       hilsplat run desk"
    log_lines(first, (20, "a", "start"), (logging.ERROR, "hilsplat", error), (20, "b", "ended"))
    log_lines(second, (20, "a", "loop"), (20, "a", "killed here"))
    screen.tell("run_info", "Job stats", stats=JOBS)
    for number, rule, log in ((1, "gaussians", first), (2, "field", second)):
        screen.start(number, rule, log)
        screen.tell("job_error", "Error in rule\n    shell: long", logging.ERROR, jobid=number)
    screen.tell(text="Exiting because a job execution failed. Look above", level=logging.ERROR)
    screen.tell("error", "CalledProcessError: returned non-zero exit status 1.", logging.ERROR)
    assert screen.text == "photos/desk gaussians: failed after 0 s\nphotos/desk field: failed after 0 s\n"
    assert run.counts() == "0 of 3 done, 2 failed, about 1 min left"
    screen.start(2, "field", second)
    assert "1 failed" in run.counts()
    before = screen.text
    screen.display.close()
    assert screen.text.removeprefix(before) == f"photos/desk gaussians failed; its log is {first}\n{error}\n"


def test_a_job_that_is_repeated_while_others_of_its_rule_wait_has_not_failed(screen, run):
    screen.tell("run_info", stats={"masks": 2})
    screen.start(1, "masks")
    screen.tell("job_error", "Error in rule", logging.ERROR, jobid=1)
    for number in (1, 2):
        screen.start(number, "masks")
        screen.end(number)
    assert run.counts() == "2 of 2 done"
    screen.display.close()
    assert screen.text.count("failed") == 1, "at the time, but not at the end"


@pytest.mark.parametrize("how", ["died with <Signals.SIGKILL: 9>", "returned non-zero exit status 137"])
def test_a_killed_job_is_explained_at_the_end(screen, tmp_path, how):
    log_lines(log := tmp_path / "gaussians.log", (20, "a", "step 5"))
    screen.start(1, "gaussians", log)
    screen.tell("job_error", "Error in rule", logging.ERROR, jobid=1)
    screen.tell("error", f"CalledProcessError: Command 'python' {how}.", logging.ERROR)
    screen.display.close()
    killed = "a job was killed, probably because memory ran out\n  fix       use fewer cores"
    assert "step 5\n" + killed in screen.text and "CalledProcessError" not in screen.text


def test_an_error_of_snakemake_itself_is_shown(screen):
    screen.tell("error", "WorkflowError: the settings are not valid", logging.ERROR)
    assert screen.text == "WorkflowError: the settings are not valid\n"


def test_a_terminal_has_a_status_line_below_the_others(run, clock):
    screen = Screen(run, Terminal())
    screen.tell("run_info", "", stats=JOBS)
    screen.start(1, "gaussians", variant="paper")
    clock.now = 100.0
    screen.tell(text="a warning", level=logging.WARNING)
    printed = screen.text
    screen.display.close()
    line = "0 of 3 done, about 5 min left | photos/desk paper gaussians"
    assert "a warning" in printed and line in printed[printed.index("a warning") :]


def log_lines(path: Path, *records: tuple[int, str, str]) -> None:
    found = [logging.LogRecord(name, level, __file__, 1, text, None, None) for level, name, text in records]
    path.write_text("".join(f"{logging.Formatter(LOG_FORMAT).format(record)}\n" for record in found))


def test_the_progress_in_a_log_is_shown_and_counts(screen, run, clock, tmp_path):
    log = tmp_path / "gaussians.log"
    screen.start(1, "gaussians", log)
    clock.now = 600.0  # later than estimated
    log_lines(log, (20, "hilsplat.base.progress", "photographs read: 3 of 4"))
    assert run.line().endswith("photos/desk gaussians: photographs read 3 of 4")
    assert run.seconds_left() == pytest.approx(60), "only the main loop counts"
    log_lines(log, (20, "hilsplat.base.progress", "fit steps: 1 of 100"))
    assert run.seconds_left() == pytest.approx(60), "so far, most of the time was compilation"
    log_lines(log, (20, "hilsplat.base.progress", "fit steps: 1 of 4"))
    assert run.line().endswith("photos/desk gaussians 1 of 4")
    assert run.seconds_left() == pytest.approx(1800)
    log_lines(log, (20, "hilsplat.base.progress", "fit steps: 4 of 4"), (20, "x", "done"))
    assert run.line().endswith("photos/desk gaussians")


def test_warnings_of_a_stage_are_printed_when_it_ends(screen, tmp_path):
    log = tmp_path / "poses.log"
    warning = (30, "hilsplat.a", "2 photographs did not register\n  IMG_1")
    log_lines(log, (20, "hilsplat.a", "start"), warning, (20, "b", "end"))
    screen.start(1, "poses", log)
    screen.end(1)
    assert screen.text.startswith("2 photographs did not register\n  IMG_1\nphotos/desk poses: 0 s")


def test_estimates_follow_what_jobs_took(run):
    estimates = progress.estimates
    job = {"dataset": "photos", "scene": "desk"}
    estimates.learn("gaussians", job, 1200.0)
    assert estimates.seconds("gaussians") == 1200
    assert estimates.seconds("field") == 240, "a slower machine makes every estimate longer"
    estimates.learn("field", job, 60.0)
    assert estimates.seconds("field") == 60


def test_a_long_last_job_is_not_divided_among_the_cores(screen, run):
    screen.start(1, "gaussians")
    run.running[1] = progress.RunningJob("gaussians", {}, 1, None, 0.0)
    assert run.seconds_left() == 600


@pytest.mark.parametrize(
    "stage", [stage for stage in all_stages().values() if stage.loop], ids=lambda stage: stage.name
)
def test_the_loop_of_a_stage_is_one_that_it_runs(stage):
    texts = [(ROOT / f"{module.replace('.', '/')}.py").read_text() for module in stage.modules()]
    assert any("track(" in text and f'"{stage.loop}"' in text for text in texts)


@pytest.mark.parametrize(
    ("seconds", "text"), [(44, "40 s"), (500, "8 min"), (7700, "2 h 10 min"), (10700, "3 h")]
)
def test_durations_are_rounded_to_the_accuracy_of_an_estimate(seconds, text):
    assert progress.duration(float(seconds)) == f"about {text}"
    assert progress.duration(3.0) == "less than 10 s"


def test_benchmark_files_of_earlier_runs_correct_the_estimates(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = Path("results/synthetic/one")
    for part in ("scene", "benchmarks", "default/benchmarks"):
        (folder / part).mkdir(parents=True)
    np.savez(folder / "scene/cameras.npz", size_hw=np.array([(500, 1000)] * 2, np.int32))
    (folder / "benchmarks/poses.jsonl").write_text(json.dumps({"s": 82.0, "cpu_time": 90.0}) + "\n")
    (folder / "default/benchmarks/clip.jsonl").write_text('{"s": 5')
    for name, content in {
        "a": "[]",
        "b": '{"s": "x", "cpu_time": 1}',
        "c": '{"s": NaN, "cpu_time": 1e999}',
    }.items():
        (folder / f"benchmarks/{name}.jsonl").write_text(content)
    resources = JobResources(plan_of(tmp_path, BENCHMARK[:1]))
    estimates = progress.Estimates(resources)
    estimates.learn_from_benchmarks()
    assert estimates.seconds("poses") == pytest.approx(90)
    slower = 90 / resources.core_seconds("poses", resources.plan.rows[0])
    assert estimates.seconds("clip") == pytest.approx(
        slower * resources.core_seconds("clip", resources.plan.rows[0])
    )
