"""What a run prints: a line per stage, a line of progress on a terminal, errors in full."""

import io
import logging

import pytest

from hilsplat.base.progress import IN_RUN, share_file, share_told, track
from hilsplat.workflow.run_progress import ProgressHandler, RunProgress, stream_handler
from hilsplat.workflow.time_left import Pace, PlannedJob


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def run(clock, tmp_path) -> RunProgress:
    def job(number, rule, seconds, after, variant=""):
        log = tmp_path / f"{rule}.log"
        return PlannedJob(
            number, rule, "photos/desk", variant, 2, frozenset(after), 0, seconds, measured_s=seconds, log=log
        )

    jobs = [
        job(1, "gaussians", 300.0, []),
        job(2, "semantic_tree", 60.0, [1], "default"),
        job(3, "field", 60.0, [2], "paper"),
    ]
    return RunProgress(jobs, Pace(), 2, clock)


def shown(run, stream) -> tuple[logging.Logger, ProgressHandler]:
    """A logger as Snakemake's, with the progress in place."""
    inner = logging.StreamHandler(stream)
    logger = logging.Logger("a run")
    handler = ProgressHandler(run, inner)
    logger.addHandler(handler)
    return logger, handler


def tell(logger, event=None, text="a block of many lines", level=logging.INFO, **more) -> None:
    logger.log(level, text, extra={"event": event, **more} if event else more)


def test_a_stage_that_ended_is_one_plain_line_in_a_file(run, clock):
    stream = io.StringIO()
    logger, _ = shown(run, stream)
    tell(logger, "job_started", jobs=[1])
    tell(logger, text="Select jobs to execute...")
    tell(logger, "job_info", jobid=1)
    clock.now = 290.0
    tell(logger, "job_finished", job_id=1)
    tell(logger, "progress", done=1, total=3)
    assert stream.getvalue() == "photos/desk gaussians: 290 s (1 of 3 done, about 2 min left)\n"


def test_the_commands_of_the_first_answer_are_said_once(run):
    stream = io.StringIO()
    logger, _ = shown(run, stream)
    for _ in range(2):
        tell(logger, "job_info", jobid=2)
        tell(logger, "job_finished", job_id=2)
    assert stream.getvalue().count('hilsplat query photos/desk "..."') == 1
    assert stream.getvalue().count("hilsplat view photos/desk") == 1


def test_errors_and_warnings_are_snakemakes_own_in_full(run):
    stream = io.StringIO()
    logger, _ = shown(run, stream)
    tell(logger, "job_info", jobid=1)
    tell(logger, "job_error", "Error in rule gaussians:\n    the whole log", logging.ERROR, jobid=1)
    tell(logger, text="a warning", level=logging.WARNING)
    tell(logger, text="Complete log(s): here")
    assert stream.getvalue() == (
        "Error in rule gaussians:\n    the whole log\na warning\nComplete log(s): here\n"
    )
    assert run.counts() == "0 of 3 done, 1 failed"  # nothing is left: the others wait for it
    tell(logger, "job_info", jobid=1)
    assert run.counts() == "0 of 3 done, about 7 min left"  # tried again


def test_snakemakes_own_filters_hold(run):
    stream = io.StringIO()
    logger, handler = shown(run, stream)
    handler.inner.addFilter(lambda record: getattr(record, "event", None) != "shellcmd")
    tell(logger, "shellcmd", "a command")
    assert stream.getvalue() == ""


def test_a_terminal_has_a_last_line_that_makes_way_for_others(run, clock):
    stream = Terminal()
    logger, handler = shown(run, stream)
    tell(logger, "job_info", jobid=1)
    clock.now = 100.0
    tell(logger, text="a warning", level=logging.WARNING)
    line = "0 of 3 done, about 5 min left | photos/desk gaussians"
    assert stream.getvalue().endswith(f"\r\033[Ka warning\n\r\033[K{line}")
    handler.close()
    assert stream.getvalue().endswith(f"{line}\r\033[K")


def test_the_share_that_a_stage_tells_is_shown_and_believed(run, clock, monkeypatch, tmp_path):
    monkeypatch.setenv(IN_RUN, "1")
    log = tmp_path / "gaussians.log"
    run.start(1)
    with share_told(log):
        loop = track(range(4), "fit steps")
        for _ in range(4):
            next(loop)
        clock.now = 600.0  # twice the estimate, but 1 of 4: the second item is told a second later at most
        assert run.line().endswith("photos/desk gaussians 1 of 4")
        assert run.seconds_left() == pytest.approx(4 * 600 - 600 + 120)
        assert list(loop) == []
        assert run.line().endswith("photos/desk gaussians")  # the loop is over, the stage is not
        clock.now = 610.0
        assert run.seconds_left() == pytest.approx(120)
    assert not share_file(log).exists()
    assert run.line().endswith("photos/desk gaussians")


def test_a_loop_that_is_not_the_whole_stage_is_named_and_tells_no_share(run, clock, monkeypatch, tmp_path):
    monkeypatch.setenv(IN_RUN, "1")
    run.start(1)
    with share_told(tmp_path / "gaussians.log"):
        loop = track(range(4), "photographs read")
        for _ in range(2):
            next(loop)
        clock.now = 100.0
        assert run.line().endswith("photos/desk gaussians: photographs read 1 of 4")
        assert run.seconds_left() == pytest.approx(200 + 120)


def test_a_stage_by_itself_writes_no_share(monkeypatch, tmp_path):
    monkeypatch.delenv(IN_RUN, raising=False)
    with share_told(tmp_path / "a.log"):
        assert list(track([1, 2], "items")) == [1, 2]
        assert list(tmp_path.iterdir()) == []


def test_variants_are_named_and_the_default_one_is_not(run):
    assert [job.name for job in run.jobs.values()] == [
        "photos/desk gaussians",
        "photos/desk semantic tree",
        "photos/desk paper field",
    ]


def test_the_handler_of_the_terminal_is_found_among_files(tmp_path):
    file, terminal = logging.FileHandler(tmp_path / "log"), logging.StreamHandler(io.StringIO())
    assert stream_handler([file, terminal]) is terminal
    assert stream_handler([file]) is None
    file.close()
