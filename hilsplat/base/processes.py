"""Processes: they end with their parent, what they left unfinished is removed, and many share a work."""

import ctypes
import functools
import hashlib
import logging
import os
import re
import shutil
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from threading import Thread
from typing import Any, TypeVar

Result = TypeVar("Result")

logger = logging.getLogger(__name__)

PARENT = "HILSPLAT_PARENT"
"""Variable that names the process whose jobs must not outlive it; the workflow sets it (rules/common.smk)."""

PR_SET_PDEATHSIG = 1
"""From Linux's <sys/prctl.h>."""


def end_with_parent(parent: int) -> None:
    """Have this process killed as soon as the one that started it ends, however that ends.

    Otherwise the jobs of a killed Snakemake go on, and write outputs of old settings beside the next run.
    The system does it where it can (Linux, no shell in between); elsewhere a thread looks every second.

    Args:
        parent: number of the process that started this one, perhaps through a shell.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if not is_alive(parent):  # it ended before the line above
        os._exit(1)
    if sys.platform != "linux" or os.getppid() != parent:
        Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while is_alive(parent):
        time.sleep(1)
    os._exit(1)


def jobs_end_with_this_process() -> None:
    """Have the commands that this process starts from now on end with it."""
    os.environ[PARENT] = str(os.getpid())


def end_with_workflow() -> None:
    """End with the Snakemake that started this job; a command that a person starts is left alone."""
    parent = os.environ.pop(PARENT, "")  # popped: what this process starts has another parent
    if parent.isdecimal():
        end_with_parent(int(parent))


LITTER = re.compile(r"\.writing-(?P<machine>[0-9a-f]{8})-(?P<pid>[0-9]+)-.*", re.DOTALL)


@functools.cache
def machine() -> str:
    """Eight digits that stand for this machine: a process number means nothing on another one."""
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


def temporary_prefix() -> str:
    """Beginning of the name of whatever this process has not finished writing.

    It is short, so that every name that fits a folder can be written, and hidden: no digest counts it.
    """
    return f".writing-{machine()}-{os.getpid()}-"


def is_alive(pid: int) -> bool:
    """Whether a process of this machine exists."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def remove_litter(folder: Path) -> list[Path]:
    """Remove what dead processes of this machine left unfinished below a folder.

    What a living process writes, or one of another machine that shares the folder, stays.

    Returns:
        what was removed.
    """
    removed = []
    for place, folders, files in os.walk(folder):
        for name in [*folders, *files]:
            found = LITTER.fullmatch(name)
            if not found or found["machine"] != machine() or is_alive(int(found["pid"])):
                continue
            path = Path(place) / name
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
            removed.append(path)
        folders[:] = [name for name in folders if not LITTER.fullmatch(name)]
    if removed:
        logger.info("removed %d unfinished files and folders of jobs that were killed", len(removed))
    return removed


def in_processes(
    work: Callable[..., Result], items: Sequence[tuple[Any, ...]], workers: int, chunk: int = 1
) -> Iterator[Result]:
    """Results of `work(*item)` in the order of `items`.

    For work that holds Python's lock. Processes are spawned, since forking a process that has threads may
    hang. With one worker or one item, no process is started.

    Args:
        work: a function at the top level of a module, or a `functools.partial` of one.
        items: arguments of each call.
        workers: number of processes.
        chunk: number of items that a process takes at a time.
    """
    if workers <= 1 or len(items) <= 1:
        for item in items:
            yield work(*item)
        return
    from concurrent.futures import ProcessPoolExecutor  # most commands start none
    from multiprocessing import get_context

    with ProcessPoolExecutor(
        min(workers, len(items)),
        mp_context=get_context("spawn"),
        initializer=end_with_parent,
        initargs=(os.getpid(),),
    ) as pool:
        yield from pool.map(work, *zip(*items, strict=True), chunksize=chunk)


def in_own_process(work: Callable[..., Result], *given: Any) -> Result:
    """`work(*given)`, computed in a process of its own, for libraries that may end theirs.

    What they print on their way out is no message for people: the end of it is the end of the error.

    Args:
        work: a function at the top level of a module.
        given: its arguments.

    Raises:
        ChildProcessError: the process ended without a result.
    """
    from concurrent.futures import ProcessPoolExecutor  # most commands start none
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        said = Path(folder) / "said"
        try:
            with ProcessPoolExecutor(
                1, mp_context=get_context("spawn"), initializer=_begin_alone, initargs=(os.getpid(), said)
            ) as pool:
                return pool.submit(work, *given).result()
        except BrokenProcessPool:
            last = said.read_text(errors="replace")[-2000:] if said.exists() else ""
            raise ChildProcessError(
                f"{work.__module__}.{work.__name__} was ended by a library\n{last}"
            ) from None


def _begin_alone(parent: int, said: Path) -> None:
    end_with_parent(parent)
    with said.open("wb") as stream:
        os.dup2(stream.fileno(), 2)
