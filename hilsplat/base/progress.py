"""Progress of long loops: a bar on a terminal, otherwise lines in a log that the enclosing run reads."""

import logging
import os
import re
import sys
import time
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from pathlib import Path
from typing import TypeVar

from hilsplat.base.errors import visible
from hilsplat.base.processes import Shared

Item = TypeVar("Item")
logger = logging.getLogger(__name__)

LOG_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
"""Log format of a stage that a run starts; `last_progress` and `warnings_in` parse it."""


class LogFormatter(logging.Formatter):  # noqa: TID251
    """Formatter of all log records that are printed."""

    def format(self, record: logging.LogRecord) -> str:
        return visible(super().format(record))


LOG_EVERY_S = 5.0  # seconds between progress lines if stderr is not a terminal
BARS = ContextVar("bars", default=True)  # whether loops show bars on a terminal

LOG_TAIL_BYTES = 20_000
PROGRESS = re.compile(
    r"^\d{4}-.* INFO hilsplat\.base\.progress: (?P<what>.+): (?P<done>\d+) of (?P<total>\d+)$", re.M
)
WARNING = re.compile(r"^\d{4}-\S+ \S+ WARNING \S+ (?P<text>.+?)(?=\n\d{4}-|\Z)", re.M | re.S)
ERROR = re.compile(r"^\d{4}-\S+ \S+ ERROR \S+ (?P<text>.+?)(?=\n\d{4}-|\Z)", re.M | re.S)


def last_progress(log: Path) -> tuple[str, int, int] | None:
    """Return the last progress reported in a stage's log (loop, items done, total items), or None."""
    *_, last = [None, *PROGRESS.finditer(_tail(log))]
    return (last["what"], int(last["done"]), int(last["total"])) if last else None


def warnings_in(log: Path) -> list[str]:
    return [match["text"].rstrip() for match in WARNING.finditer(_tail(log, sys.maxsize))]


def last_error(log: Path) -> str:
    """Return the last error in a stage's log or, if the stage was killed, the log's last lines."""
    *_, last = [None, *ERROR.finditer(_tail(log, sys.maxsize))]
    return last["text"].rstrip() if last else "\n".join(_tail(log).splitlines()[-5:])


def _tail(log: Path, num_bytes: int = LOG_TAIL_BYTES) -> str:
    try:
        with log.open("rb") as stream:
            stream.seek(max(0, stream.seek(0, os.SEEK_END) - num_bytes))
            return stream.read().decode("utf-8", errors="replace")
    except OSError:  # the job has not created the log yet
        return ""


def track(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items and show how many are done; `what` is a label such as "masks of views"."""
    if total is None:
        total = len(items) if isinstance(items, Sized) else None
    if sys.stderr.isatty() and BARS.get():
        from rich.console import Console  # slow to import
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            yield from progress.track(items, total, description=what)
        return
    last = time.monotonic()
    for done, item in enumerate(items, start=1):
        yield item
        now = time.monotonic()
        if now - last >= LOG_EVERY_S:
            logger.info("%s: %d of %s", what, done, total if total is not None else "?")
            last = now


@contextmanager
def reporting(progress: bool) -> Iterator[None]:
    """Print what the block does to stderr; without `progress`, only what loggers of the user print."""
    bars = BARS.set(progress)
    try:
        with _LOGGED if progress else nullcontext():
            yield
    finally:
        BARS.reset(bars)


@contextmanager
def _logged() -> Iterator[None]:
    logs, handler = logging.getLogger("hilsplat"), logging.StreamHandler()
    handler.setFormatter(LogFormatter("%(message)s"))
    level = logs.level
    logs.addHandler(handler)
    logs.setLevel(logging.INFO)
    try:
        yield
    finally:
        logs.removeHandler(handler)
        logs.setLevel(level)


_LOGGED = Shared(_logged)


@contextmanager
def stage_log(stage: str, scene: str) -> Iterator[dict[str, object]]:
    """Yield a dict for a stage's counts; log the start of the stage, and its end together with the counts."""
    counts: dict[str, object] = {}
    logger.info("%s %s: start", stage, scene)
    start = time.monotonic()
    yield counts
    text = ", ".join(f"{name} {value}" for name, value in counts.items())
    logger.info(
        "%s %s: done in %.1f s%s", stage, scene, time.monotonic() - start, f" ({text})" if text else ""
    )
