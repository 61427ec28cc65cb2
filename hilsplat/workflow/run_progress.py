"""The progress of a run, in place of Snakemake's block of lines per job.

On a terminal the last line tells which stages of which scenes run, how far the run is and the time left, and
a line stays for each stage that ended. Elsewhere, as in a file, there is that one line per stage. Warnings
and errors are Snakemake's own, in full; so is its log in `.snakemake/log`.

Snakemake is known here only by the attributes of its log records.
"""

import logging
import shutil
import threading
import time
from collections.abc import Callable, Iterable

from hilsplat.base.progress import read_share
from hilsplat.workflow.time_left import LOOPS, Pace, PlannedJob, duration, left_of_running, time_left

DRAW_EVERY_S = 1.0
ESTIMATE_EVERY_S = 5.0

CLEAR = "\r\033[K"

REPLACED = frozenset({"progress", "job_started"})
"""Events that the progress makes superfluous, beside start and end of a job."""

CHATTER = "Select jobs to execute..."
"""A message of Snakemake's before every job; it has no event."""


class RunProgress:
    """What has been done of a run, and what the rest takes.

    Args:
        jobs: all jobs of the run.
        pace: what earlier runs measured.
        cores: cores of the run.
        clock: seconds that only grow.
    """

    def __init__(
        self,
        jobs: Iterable[PlannedJob],
        pace: Pace,
        cores: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.jobs = {job.id: job for job in jobs}
        self.pace, self.cores, self.clock = pace, cores, clock
        self.begun: dict[int, float] = {}
        self.ended: set[int] = set()
        self.failed: set[int] = set()
        self._hint_told = False
        self._left: tuple[float, float] | None = None

    def start(self, job: int) -> None:
        """A job begins, perhaps once more."""
        if job in self.jobs:
            self.failed.discard(job)
            self.begun[job] = self.clock()
            self._left = None

    def fail(self, job: int) -> None:
        """A job ended with an error; nothing that waits for it will run."""
        if self.begun.pop(job, None) is not None:
            self.failed.add(job)
            self._left = None

    def end(self, job: int) -> list[str]:
        """A job ended well; returns what is worth a line."""
        begun = self.begun.pop(job, None)
        if begun is None:
            return []
        self._left = None
        self.ended.add(job)
        done, seconds = self.jobs[job], self.clock() - begun
        self.pace.learn(done, seconds)
        return [f"{done.name}: {seconds:.0f} s ({self.counts()})", *self._hint(done)]

    def counts(self) -> str:
        """How many jobs are done, and how long the others take."""
        text = f"{len(self.ended)} of {len(self.jobs)} done"
        text += f", {len(self.failed)} failed" if self.failed else ""
        return f"{text}, {duration(self.seconds_left())} left" if self.begun or self._waiting() else text

    def _waiting(self) -> list[PlannedJob]:
        """Jobs that are still to begin: not those that wait for one that failed."""
        lost = set(self.failed)
        while more := {number for number, job in self.jobs.items() if job.after & lost} - lost:
            lost |= more
        over = self.ended | lost | set(self.begun)
        return [job for number, job in self.jobs.items() if number not in over]

    def line(self) -> str:
        """The line that is drawn again and again; empty: nothing runs."""
        shown = [self._running(job) for job in sorted(self.begun)]
        return f"{self.counts()} | {', '.join(shown)}" if shown else ""

    def _running(self, number: int) -> str:
        job, told = self.jobs[number], self._told(number)
        if told is None or told[1] == told[2]:  # the loop is over, the stage is not
            return job.name
        loop = "" if told[0] == LOOPS.get(job.rule) else f": {told[0]}"
        return f"{job.name}{loop} {told[1]} of {told[2]}"

    def _told(self, number: int) -> tuple[str, int, int] | None:
        log = self.jobs[number].log
        return read_share(log) if log is not None else None

    def seconds_left(self) -> float:
        """Seconds until the run ends."""
        now = self.clock()
        if self._left is None or now - self._left[0] >= ESTIMATE_EVERY_S:
            self._left = (now, self._estimate(now))
        return max(self._left[1] - (now - self._left[0]), 0.0)

    def _estimate(self, now: float) -> float:
        running = {}
        for number, begun in self.begun.items():
            job, told = self.jobs[number], self._told(number)
            share = told[1] / told[2] if told is not None and told[0] == LOOPS.get(job.rule) else 0.0
            left = left_of_running(self.pace.seconds(job), now - begun, share)
            running[number] = (min(job.threads, self.cores), left)
        return time_left(self._waiting(), running, self.pace.seconds, self.cores)

    def _hint(self, job: PlannedJob) -> list[str]:
        """The commands that a scene answers from now on; said once in a run."""
        if self._hint_told or job.rule != "semantic_tree" or job.variant != "default":
            return []
        self._hint_told = True
        return [
            f"{job.scene} answers from now on:",
            f'  hilsplat query {job.scene} "..."',
            f"  hilsplat view {job.scene}",
        ]


class ProgressHandler(logging.Handler):
    """Shows the progress of a run, and hands all other records to Snakemake's handler.

    Args:
        run: the progress.
        inner: Snakemake's handler of the terminal; it keeps its filters and colours.
    """

    def __init__(self, run: RunProgress, inner: logging.StreamHandler) -> None:
        super().__init__()
        self.run, self.inner, self.stream = run, inner, inner.stream
        self._over = threading.Event()
        self._drawn = False
        if self.stream.isatty():
            threading.Thread(target=self._draw_on, daemon=True, name="progress").start()

    def emit(self, record: logging.LogRecord) -> None:
        """Count a job, or show a record."""
        event = getattr(record, "event", None)
        if event in REPLACED or record.msg == CHATTER:
            return
        self._clear()
        if event == "job_info":
            self.run.start(record.__dict__["jobid"])
        elif event == "job_finished":
            self._write(*self.run.end(record.__dict__["job_id"]))
        else:
            if event == "job_error":
                self.run.fail(record.__dict__["jobid"])
            self.inner.handle(record)
        self._draw()

    def close(self) -> None:
        """End the line."""
        self._over.set()
        self.acquire()
        self._clear()
        self.release()
        self.inner.close()
        super().close()

    def _draw_on(self) -> None:
        while not self._over.wait(DRAW_EVERY_S):
            self.acquire()
            try:
                self._draw()
            finally:
                self.release()

    def _draw(self) -> None:
        if not self.stream.isatty() or self._over.is_set():
            return
        line = self.run.line()
        width = shutil.get_terminal_size().columns - 1
        self.stream.write(CLEAR + (line if len(line) <= width else line[: width - 3] + "..."))
        self.stream.flush()
        self._drawn = bool(line)

    def _clear(self) -> None:
        if self._drawn:
            self.stream.write(CLEAR)
            self._drawn = False

    def _write(self, *lines: str) -> None:
        for line in lines:
            self.stream.write(f"{line}\n")
        self.stream.flush()


def stream_handler(handlers: Iterable[logging.Handler]) -> logging.StreamHandler | None:
    """The handler that writes to the terminal; None: another logger was chosen."""
    found = (each for each in handlers if isinstance(each, logging.StreamHandler))
    return next((each for each in found if not isinstance(each, logging.FileHandler)), None)
