"""NVIDIA cards of this machine as the driver reports them, and a lock on each, so that jobs don't share one.

Nothing here imports torch or starts CUDA.
"""

import ctypes
import logging
import os
import tempfile
import time
from pathlib import Path
from typing import IO

from hilsplat.base.processes import lock

logger = logging.getLogger(__name__)

MANAGEMENT, CUDA = "libnvidia-ml.so.1", "libcuda.so.1"  # libraries of the driver
_held: list[IO[bytes]] = []  # the lock of this process's card


def has_driver() -> bool:
    """Return whether an NVIDIA driver is installed."""
    try:
        ctypes.CDLL(CUDA)
    except OSError:
        return False
    return True


def driver_version() -> str:
    """Return the version of the NVIDIA driver, or an empty text if there is none."""
    version = ctypes.create_string_buffer(80)
    try:
        library = ctypes.CDLL(MANAGEMENT)
        library.nvmlInit_v2()
        library.nvmlSystemGetDriverVersion(version, len(version))
    except (OSError, AttributeError):
        return ""
    return version.value.decode()


def cards() -> list[str]:
    """Return the cards that this process may use, named as in `CUDA_VISIBLE_DEVICES`."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return [name.strip() for name in named.split(",") if name.strip() not in ("", "-1")]
    count = ctypes.c_uint(0)
    try:
        library = ctypes.CDLL(MANAGEMENT)
        if library.nvmlInit_v2() == 0:
            library.nvmlDeviceGetCount_v2(ctypes.byref(count))
            library.nvmlShutdown()
    except (OSError, AttributeError):  # no driver, or one from before 2011
        return []
    return [str(number) for number in range(count.value)]


def take_card(folder: Path | None = None, poll_s: float = 1.0) -> None:
    """Wait for a card that no other job of this user has, and let CUDA see only that card.

    It must be called before CUDA starts. The card is kept until `release_card` or the end of the process,
    even if it is killed. A process that has a card keeps it. Under Slurm, only processes of one Slurm job
    share its cards, whose names may be those of other jobs' cards.
    """
    choice = cards()
    if not choice or _held:
        return
    folder, is_waiting = folder or Path(tempfile.gettempdir()), False
    owner = "-".join(filter(None, (str(os.getuid()), os.environ.get("SLURM_JOB_ID"))))
    while True:
        for name in choice:
            stream = (folder / f"hilsplat-{owner}-card-{name.replace('/', '_')}.lock").open("ab")
            try:
                lock(stream, wait=False)
            except BlockingIOError:
                stream.close()
                continue
            _held.append(stream)
            os.environ["CUDA_VISIBLE_DEVICES"] = name  # in CUDA's own order, which is the same in each job
            return
        if not is_waiting:
            logger.info("waiting for one of %d cards, which other jobs use", len(choice))
            is_waiting = True
        time.sleep(poll_s)


def release_card() -> None:
    """Let other jobs take this process's card, because it turned out that the CPU is used."""
    while _held:
        _held.pop().close()
