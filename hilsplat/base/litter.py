"""Temporary files of jobs: names that tell who writes them, and removal once the writer is dead."""

import functools
import hashlib
import logging
import os
import re
import shutil
import socket
from pathlib import Path

logger = logging.getLogger(__name__)

NAME = re.compile(r"\.writing-(?P<machine>[0-9a-f]{8})-(?P<pid>[0-9]+)-.*", re.DOTALL)


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
            found = NAME.fullmatch(name)
            if not found or found["machine"] != machine() or is_alive(int(found["pid"])):
                continue
            path = Path(place) / name
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
            removed.append(path)
        folders[:] = [name for name in folders if not NAME.fullmatch(name)]
    if removed:
        logger.info("removed %d unfinished files and folders of jobs that were killed", len(removed))
    return removed
