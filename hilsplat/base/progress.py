"""Progress of long work: a bar on a terminal, sparse lines in a log, a small file for the run around it."""

import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress

Item = TypeVar("Item")
logger = logging.getLogger(__name__)

LOG_EVERY_S = 15.0
"""Seconds between progress lines if there is no terminal to draw a bar on."""

TELL_EVERY_S = 1.0
"""Seconds between two writings of a stage's share."""

IN_RUN = "HILSPLAT_IN_RUN"
"""Environment variable that a run sets for its stages: it shows their progress, and they are quiet."""

_share_file: Path | None = None


def in_run() -> bool:
    """Whether this process is a stage of a run that shows the progress itself."""
    return bool(os.environ.get(IN_RUN))


def share_file(log: Path) -> Path:
    """Where a stage with this log tells the run how far it is."""
    return log.with_suffix(".progress")


@contextmanager
def share_told(log: Path | None) -> Iterator[None]:
    """Tell the run, if there is one, how far the loops of this stage are, until it ends."""
    global _share_file
    _share_file = share_file(log) if log is not None and in_run() else None
    try:
        yield
    finally:
        if _share_file is not None:
            _share_file.unlink(missing_ok=True)
        _share_file = None


def read_share(log: Path) -> tuple[str, int, int] | None:
    """What a running stage told last: which loop, how many items are done, and of how many; None: nothing."""
    try:
        what, done, total = json.loads(share_file(log).read_text(encoding="utf-8"))
    except (OSError, ValueError):  # not begun, or over
        return None
    return what, done, total


def _tell(what: str, done: int, total: int) -> None:
    assert _share_file is not None
    temporary = _share_file.with_suffix(".progress.tmp")
    temporary.write_text(json.dumps([what, done, total]), encoding="utf-8")
    temporary.replace(_share_file)


def _bar(*measures: str) -> "Progress":
    """A bar on the terminal, with these columns of `rich.progress` before the time left."""
    from rich import progress  # takes a while to import
    from rich.console import Console

    columns = [progress.TextColumn("{task.description}"), progress.BarColumn()]
    columns += [getattr(progress, name)() for name in (*measures, "TimeRemainingColumn")]
    return progress.Progress(*columns, console=Console(stderr=True), transient=True)


def track(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items, showing how many are done.

    Args:
        items: what to iterate over.
        what: a few words, such as "masks of views".
        total: number of items, if `len(items)` is not available.
    """
    if total is None:
        total = len(items) if isinstance(items, Sized) else None
    if sys.stderr.isatty() and not in_run():
        with _bar("MofNCompleteColumn") as progress:
            task = progress.add_task(what, total=total)
            for item in items:
                yield item
                progress.advance(task)
        return
    last, told = time.monotonic(), -TELL_EVERY_S
    for done, item in enumerate(items, start=1):
        yield item
        now = time.monotonic()
        if now - last >= LOG_EVERY_S and done != total:
            logger.info("%s: %d of %s", what, done, total if total is not None else "?")
            last = now
        if _share_file is not None and total and (now - told >= TELL_EVERY_S or done == total):
            _tell(what, done, total)
            told = now


@contextmanager
def transfer_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show how many bytes of a transfer are there; yields the function that is told that number.

    Args:
        what: name of what is transferred.
        total: its bytes.
    """
    if sys.stderr.isatty() and not in_run():
        with _bar("DownloadColumn", "TransferSpeedColumn") as progress:
            task = progress.add_task(what, total=total)
            yield lambda reached: progress.update(task, completed=reached)
        return
    last = time.monotonic()

    def tell(reached: int) -> None:
        nonlocal last
        if time.monotonic() - last >= LOG_EVERY_S and reached != total:
            logger.info("%s: %.0f of %.0f MB", what, reached / 1e6, total / 1e6)
            last = time.monotonic()

    yield tell


@contextmanager
def stage_log(stage: str, scene: str) -> Iterator[dict[str, object]]:
    """Log one line when a stage starts and one when it ends, with the counts that matter.

    Yields a dict; the closing line prints what the stage puts in it.
    """
    counts: dict[str, object] = {}
    logger.info("%s %s: start", stage, scene)
    start = time.monotonic()
    yield counts
    text = ", ".join(f"{name} {value}" for name, value in counts.items())
    logger.info(
        "%s %s: done in %.1f s%s", stage, scene, time.monotonic() - start, f" ({text})" if text else ""
    )
