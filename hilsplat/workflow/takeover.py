"""What a run that was killed leaves behind, settled by the next one: Snakemake's lock, unfinished files."""

import fcntl
import logging
import os
from pathlib import Path

from hilsplat.base.processes import machine, remove_litter

logger = logging.getLogger(__name__)

_held: list[object] = []
"""Open files: the system frees their locks when this process ends, however it ends."""


def take_over(state: Path, results: Path) -> str | None:
    """Hold the project for this run and, if the last one was killed on this machine, tidy up after it.

    Does nothing while another run holds the project: whether the two may run at once is for Snakemake's own
    lock to say. That lock is a file without an owner, which stays when its run is killed.

    Args:
        state: Snakemake's folder, `.snakemake`.
        results: folder in which its jobs write.

    Returns:
        a notice if a lock was lifted.
    """
    stream = (state / "hilsplat.lock").open("a+", encoding="utf-8")
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        return None
    _held.append(stream)
    stream.seek(0)
    former = stream.read().split()
    stream.truncate(0)
    stream.write(f"{machine()} {os.getpid()}\n")
    stream.flush()
    remove_litter(results)
    locks = sorted((state / "locks").glob("*.lock"))
    if not locks or former[:1] != [machine()]:  # a run of another machine may go on there
        return None
    for lock in locks:
        lock.unlink()
    return f"lifted the lock of a run that was killed (process {former[1]}); finished work is kept"
