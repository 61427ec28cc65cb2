"""Progress of long work: a bar on a terminal, sparse lines in a log."""

import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

Item = TypeVar("Item")
logger = logging.getLogger(__name__)

LOG_EVERY_S = 15.0
"""Seconds between progress lines if there is no terminal to draw a bar on."""


def track(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items, showing how many are done.

    Args:
        items: what to iterate over.
        what: a few words, such as "masks of views".
        total: number of items, if `len(items)` is not available.
    """
    if total is None:
        total = len(items) if isinstance(items, Sized) else None
    if sys.stderr.isatty():
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task(what, total=total)
            for item in items:
                yield item
                progress.advance(task)
        return
    last = time.monotonic()
    for done, item in enumerate(items, start=1):
        yield item
        if time.monotonic() - last >= LOG_EVERY_S and done != total:
            logger.info("%s: %d of %s", what, done, total if total is not None else "?")
            last = time.monotonic()


@contextmanager
def transfer_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show how many bytes of a transfer are there; yields the function that is told that number.

    Args:
        what: name of what is transferred.
        total: its bytes.
    """
    if sys.stderr.isatty():
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            DownloadColumn(),
            TransferSpeedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
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
