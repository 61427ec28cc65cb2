"""Loops compiled by numba, with the GIL released and cached on disk; compiling is announced in the log.

numba recompiles a cached loop if the loop's own file changes, but not if a loop that it calls, from another
file, changes. Machine code is therefore kept in a folder whose name is a digest of all files with loops: the
modules of this package, and the modules of the loop's own package whose names end in `kernels`.
"""

import functools
import hashlib
import inspect
import logging
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
from numba.core import event

logger = logging.getLogger(__name__)
config: Any = numba.config

MAX_IDLE_DAYS = 30.0  # machine code of other versions is deleted if no process has used it for this long

_FOLDER = re.compile(r"kernels-[0-9a-f]{16}")
_lock = threading.Lock()
_packages = set[str]()  # with loops of this kind


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Apply `numba.njit` with the GIL released, and cache the machine code on disk."""
    if function is None:
        return lambda later: compiled(later, **options)
    function = inspect.unwrap(function)  # type checkers of tests wrap functions
    package = function.__module__.partition(".")[0]
    _packages.add(package)
    with _cache_in(_folder_of(package)):
        return numba.njit(nogil=True, cache=True, **options)(function)


@functools.cache
def _folder_of(package: str) -> str:
    """Return the folder for a package's machine code; delete folders that have long been unused.

    It is in `NUMBA_CACHE_DIR` if that is set, else in the first folder that can be written: the package, the
    user's cache folder, or a private one among the temporary files.
    """
    this_package = Path(__file__).parent
    root = Path(next(iter(getattr(sys.modules.get(package), "__path__", [this_package]))))
    files = sorted({*this_package.glob("*.py"), *_kernel_modules(root)})
    digest = hashlib.sha256()
    for file in files:
        # with the time: if a file is edited while a process starts, and restored later, it counts as new
        stamp = f"{file.parent.name}/{file.name} {file.stat().st_mtime_ns}\n"
        digest.update(stamp.encode() + file.read_bytes())
    parent = Path(config.CACHE_DIR) if config.CACHE_DIR else _writable_parent(root)
    folder = parent / f"kernels-{digest.hexdigest()[:16]}"
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        for other in parent.iterdir():
            idle_days = (time.time() - other.stat().st_mtime) / 86400
            if _FOLDER.fullmatch(other.name) and idle_days > MAX_IDLE_DAYS:
                shutil.rmtree(other, ignore_errors=True)
    return str(folder)


def _writable_parent(root: Path) -> Path:
    beside = root / "__pycache__"
    if os.access(beside if beside.exists() else root, os.W_OK):
        return beside
    with suppress(OSError, RuntimeError):  # RuntimeError: a user without a home
        of_user = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "cpusplat"
        of_user.mkdir(parents=True, exist_ok=True)
        if os.access(of_user, os.W_OK):
            return of_user
    temporary = Path(tempfile.gettempdir(), f"cpusplat-{os.getuid()}")
    with suppress(FileExistsError):
        temporary.mkdir(mode=0o700)
    stat = temporary.lstat()
    is_ours = stat.st_uid == os.getuid() and not stat.st_mode & 0o077  # a link has all permissions
    return temporary if is_ours else Path(tempfile.mkdtemp(prefix="cpusplat-"))


def _kernel_modules(root: Path) -> Iterator[Path]:
    for folder, folders, files in os.walk(root):
        folders[:] = [name for name in folders if name != "__pycache__"]  # it has thousands of files
        yield from (Path(folder, name) for name in files if name.endswith("kernels.py"))


@contextmanager
def _cache_in(folder: str) -> Iterator[None]:
    """Let numba choose a folder for the loops that are declared in the block."""
    with _lock:
        before, config.CACHE_DIR = config.CACHE_DIR, folder
        try:
            yield
        finally:
            config.CACHE_DIR = before


class _Notice(event.Listener):
    """Logs one notice when loops are compiled; loading them from the cache raises no event."""

    is_given = False

    def on_start(self, happening: Any) -> None:
        module = happening.data["dispatcher"].py_func.__module__ or ""
        if not self.is_given and module.partition(".")[0] in _packages:
            self.is_given = True
            logger.info("compiling kernels, which takes about 15 s; later runs load them from disk")

    def on_end(self, happening: Any) -> None:
        pass


event.register("numba:compile", _Notice())
