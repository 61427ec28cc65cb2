"""Progress of a run: a line per finished stage, and on a terminal a status line with the time left.

This module reads only attributes of log records; `snakemake_logger_plugin_hilsplat` connects it to Snakemake.
Snakemake's own messages are only in its log file, except for warnings and errors. Errors of failed jobs are
printed at the end of the run, so that they are the last lines.
"""

import logging
import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from io import TextIOBase
from pathlib import Path
from types import SimpleNamespace
from typing import IO, cast

from rich.console import Console
from rich.live import Live
from rich.text import Text

from hilsplat import stages
from hilsplat.base.artifacts import INDEX, parse_json
from hilsplat.base.errors import KILLED, KILLED_FIX, visible
from hilsplat.base.progress import last_error, last_progress, warnings_in
from hilsplat.scene.finished import KEY_VIEWS, command_name, refining
from hilsplat.workflow.resources import START_S, JobResources
from hilsplat.workflow.scene_data import Job

KEPT = ("Nothing to be done", "This was a dry-run")
"""Beginnings of the messages of Snakemake that are printed although they are no warnings."""

PLANNED = frozenset({"run_info", "shellcmd"})  # events that a dry run prints as Snakemake does

FOLLOWING = ("At least one job did not complete", "Exiting because a job execution failed")
"""Parts of errors that only repeat that a job has failed."""

COMMAND_FAILED = "CalledProcessError"
"""Part of an error that quotes the command of a failed job, just before the event of its failure."""

TARGETS = ("all", "everything", "tables", "total")  # entries of the job counts that are not jobs
QUERIED = (stages.semantic_tree.file, stages.clip.file)  # artifacts of a variant that queries need
SIGKILL = ("died with <Signals.SIGKILL", "exit status 137")  # how Snakemake reports a job that was killed

STARTED = 0.1
"""Share of a loop from which its speed predicts the rest; before, start-up and compilation dominate."""


@dataclass(frozen=True)
class RunningJob:
    """A running job; `start_s` is read from the run's clock."""

    rule: str
    wildcards: Mapping[str, str]
    threads: int
    log: Path | None
    start_s: float

    @property
    def name(self) -> str:
        """Scene, variant unless it is the default, and stage."""
        places = [self.wildcards.get(name, "") for name in ("dataset", "scene", "variant")]
        scene = "/".join(filter(None, places[:2]))
        variant = "" if places[2] == "default" else places[2]
        table = self.wildcards.get("table", self.wildcards.get("sweep", ""))
        return " ".join(filter(None, [scene, variant, self.rule.replace("_", " "), table]))

    @property
    def loop(self) -> str:
        """The loop that takes almost all of the job's time."""
        stage = stages.all_stages().get(self.rule)
        return stage.loop if stage else ""

    def progress(self) -> tuple[str, int, int] | None:
        """Return the loop, items done and total items from the log, or None outside a loop."""
        latest = last_progress(self.log) if self.log is not None else None
        return latest if latest is not None and latest[1] < latest[2] else None


class Estimates:
    """Core seconds of jobs: estimates by rule, scaled by the measured times of finished jobs.

    Without `resources`, which needs a plan, each job is estimated at `START_S`. `is_dry` is set by the logger
    plugin before the Snakefile is read.
    """

    def __init__(self, resources: JobResources | None = None) -> None:
        self.resources = resources
        self.is_dry = False
        self._measured, self._estimated = defaultdict[str, float](float), defaultdict[str, float](float)
        self._means: dict[str, float] = {}

    def learn(self, rule: str, wildcards: Mapping[str, str], core_s: float) -> None:
        """Add the measured core seconds of a job."""
        estimate = self._estimate(rule, SimpleNamespace(**wildcards)) if "scene" in wildcards else START_S
        for key in (rule, ""):
            self._measured[key] += core_s
            self._estimated[key] += estimate

    def learn_from_benchmarks(self) -> None:
        """Add the times of earlier runs' jobs from Snakemake's benchmark files."""
        if self.resources is None:
            return
        for row in self.resources.plan.rows:
            folder = Path(self.resources.plan.path(row))
            for file in [*folder.glob("benchmarks/*.jsonl"), *folder.glob("*/benchmarks/*.jsonl")]:
                job = {"dataset": row.dataset, "scene": row.scene}
                try:
                    last = parse_json(file.read_text(encoding="utf-8").splitlines()[-1])
                    core_s = max(float(last["cpu_time"]), float(last["s"]))
                    if 0 <= core_s < math.inf:
                        self.learn(file.stem, job, core_s)
                except (OSError, ValueError, KeyError, IndexError, TypeError):  # a job may be writing to it
                    continue

    def seconds(self, rule: str) -> float:
        """Return the mean core seconds of a job of this rule."""
        if rule not in self._means:
            rows = self.resources.plan.scenes if self.resources else ()
            jobs = [self._estimate(rule, row) for row in rows]
            self._means[rule] = sum(jobs) / len(jobs) if jobs else START_S
        key = rule if rule in self._estimated else ""
        scale = self._measured[key] / self._estimated[key] if key in self._estimated else 1.0
        return self._means[rule] * scale

    def _estimate(self, rule: str, job: Job) -> float:
        return self.resources.core_seconds(rule, job) if self.resources else START_S


estimates = Estimates()
"""Estimates of this process's run; the Snakefile sets `estimates.resources` after it has read the plan."""


class RunProgress:
    """Waiting, running and finished jobs of a run, and the time left; `clock` returns seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self.cores = 1
        self.total = self.done = self.failed = 0
        self.waiting = Counter[str]()
        self.running: dict[int, RunningJob] = {}
        self.failures: dict[int, RunningJob] = {}
        self._hint_given = False
        self._refined: set[str] = set()

    def begin(self, jobs: Mapping[str, int]) -> None:
        self.waiting = Counter({rule: number for rule, number in jobs.items() if rule not in TARGETS})
        self.total = self.waiting.total()
        estimates.learn_from_benchmarks()

    def start(self, number: int, job: RunningJob) -> None:
        """Start a job, or restart a failed one."""
        if job.rule in TARGETS:
            return
        if self.failures.pop(number, None) is not None:
            self.failed -= 1
        elif self.waiting[job.rule] > 0:
            self.waiting[job.rule] -= 1
        self.running[number] = job

    def fail(self, number: int) -> str:
        """End a job that failed, and return the line to print; empty for an unknown job."""
        job = self.running.pop(number, None)
        if job is None:
            return ""
        self.failed += 1
        self.failures[number] = job
        return f"{job.name}: failed after {self.clock() - job.start_s:.0f} s"

    def errors(self) -> list[str]:
        """Return the errors of the jobs that failed and were not repeated, each once."""
        messages: dict[str, str] = {}
        for job in self.failures.values():
            error = last_error(job.log) if job.log is not None else ""
            where = f"; its log is {job.log}" if job.log is not None else ""
            messages.setdefault(error or job.name, f"{job.name} failed{where}\n{error}".rstrip())
        return [*messages.values()]

    def end(self, number: int) -> list[str]:
        """End a job, and return the lines to print."""
        job = self.running.pop(number, None)
        if job is None:
            return []
        self.done += 1
        seconds = self.clock() - job.start_s
        estimates.learn(job.rule, job.wildcards, seconds * job.threads)
        warnings = warnings_in(job.log) if job.log is not None else []
        return [*warnings, f"{job.name}: {seconds:.0f} s ({self.counts()})", *self._hint(job)]

    def counts(self) -> str:
        failed = f", {self.failed} failed" if self.failed else ""
        left = f", {duration(self.seconds_left())} left" if self.running or self.waiting.total() else ""
        return f"{self.done} of {self.total} done{failed}{left}"

    def line(self) -> str:
        """Return the terminal's status line; empty if nothing runs."""
        jobs = [self._describe(self.running[number]) for number in sorted(self.running)]
        return visible(f"{self.counts()} | {', '.join(jobs)}") if jobs else ""

    def _describe(self, job: RunningJob) -> str:
        progress = job.progress()
        if progress is None:
            return job.name
        loop = "" if progress[0] == job.loop else f": {progress[0]}"
        return f"{job.name}{loop} {progress[1]} of {progress[2]}"

    def seconds_left(self) -> float:
        """Return the remaining core seconds per core, but at least the longest job's remaining time."""
        waiting = sum(number * estimates.seconds(rule) for rule, number in self.waiting.items() if number)
        running = [(self._left(job), job.threads) for job in self.running.values()]
        spread = (waiting + sum(left * threads for left, threads in running)) / self.cores
        return max([spread, *(left for left, _ in running)])

    def _left(self, job: RunningJob) -> float:
        """Return a running job's remaining seconds, from its progress once it is past `STARTED`."""
        elapsed, progress = self.clock() - job.start_s, job.progress()
        if progress and progress[1] > STARTED * progress[2] and progress[0] == job.loop:
            return elapsed * (progress[2] / progress[1] - 1)
        return max(estimates.seconds(job.rule) / job.threads - elapsed, 0.1 * elapsed)

    def _hint(self, job: RunningJob) -> list[str]:
        """Return a line when a scene is ready to query, with the query commands once per run."""
        variant, stage = job.wildcards.get("variant"), stages.all_stages().get(job.rule)
        if stage is None or stage.file not in QUERIED or variant not in ("default", KEY_VIEWS):
            return []
        others = [name for name in QUERIED if name != stage.file]
        if job.log is None or not all((job.log.parents[1] / name / INDEX).is_file() for name in others):
            return []
        folder = job.log.parents[2]
        scene = command_name(folder)
        commands = [] if self._hint_given else [f'  hilsplat query {scene} "..."', f"  hilsplat view {scene}"]
        if variant == KEY_VIEWS:
            self._refined.add(scene)
            commands = [refining(folder), *commands]
        elif scene in self._refined:
            return [f"{scene} uses all photographs"]
        elif self._hint_given:
            return []
        self._hint_given = True
        return [f"{scene} is ready to query:", *commands]


class ProgressDisplay:
    """Output of progress, warnings and errors to a terminal or a file; `text` formats other log records."""

    def __init__(
        self, stream: TextIOBase, text: Callable[[logging.LogRecord], str], run: RunProgress
    ) -> None:
        self.text, self.run, self._was_killed = text, run, False
        file = cast(IO[str], stream)
        self._console = Console(file=file, highlight=False, markup=False, emoji=False, soft_wrap=True)
        self._line = Live(
            console=self._console,
            get_renderable=self._draw,
            refresh_per_second=1,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
        )
        self._line.start()

    def show(self, record: logging.LogRecord) -> None:
        """Update the progress from a log record, and print jobs, warnings, errors and our messages."""
        event, facts, lines = getattr(record, "event", None), record.__dict__, []
        if event == "resources_info" and facts.get("cores"):
            self.run.cores = facts["cores"]
        elif event == "run_info":
            self.run.begin(facts["stats"])
        elif event == "job_info":
            log = next(map(Path, facts["log"]), None)
            job = RunningJob(facts["rule_name"], facts["wildcards"], facts["threads"], log, self.run.clock())
            self.run.start(facts["jobid"], job)
        elif event == "job_finished":
            lines = self.run.end(facts["job_id"])
        elif event == "job_error" and (failed := self.run.fail(facts["jobid"])):
            lines = [failed]
        elif record.levelno >= logging.WARNING:
            lines = [self.text(record)]
            self._was_killed |= any(sign in lines[0] for sign in SIGKILL)
            is_repeated = self.run.failures and any(words in lines[0] for words in FOLLOWING)
            if is_repeated or COMMAND_FAILED in lines[0]:
                lines = []
        elif is_shown(record):
            lines = [self.text(record)]
        self._print(lines, {logging.WARNING: "yellow", logging.ERROR: "red"}.get(record.levelno))
        self._line.refresh()

    def _print(self, lines: Iterable[str], style: str | None) -> None:
        for line in lines:
            self._console.print(visible(line), style=style)

    def close(self) -> None:
        """Remove the status line, and print the errors of failed jobs."""
        self._line.stop()
        self._print(self.run.errors(), "red")
        if self._was_killed:
            self._print([f"a job was killed, {KILLED}\n  fix       {KILLED_FIX}"], "red")
        self.run.failures.clear()
        self._was_killed = False

    def _draw(self) -> Text:
        return Text(self.run.line() if self._console.is_terminal else "", no_wrap=True, overflow="ellipsis")


def is_shown(record: logging.LogRecord) -> bool:
    """Return whether a message is a warning, is in `KEPT`, or is from our Snakefile or rules."""
    is_ours = getattr(record, "event", None) is None and Path(record.pathname).suffix != ".py"
    return record.levelno >= logging.WARNING or is_ours or record.getMessage().startswith(KEPT)


def duration(seconds: float) -> str:
    """Return a duration as text, rounded because it is an estimate."""
    if seconds < 10:
        return "less than 10 s"
    if seconds < 55:
        return f"about {round(seconds, -1):.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"about {max(minutes, 1)} min"
    hours, minutes_left = divmod(round(minutes, -1), 60)
    return f"about {hours} h {minutes_left} min" if minutes_left else f"about {hours} h"
