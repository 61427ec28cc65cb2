"""Caches: finished views and checkpoints, their sizes and pruning, and examinations of this machine."""

import functools
import getpass
import logging
import os
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import platformdirs

from hilsplat.base.artifacts import read_npz, write_arrays, write_text
from hilsplat.base.atomic import existing_folder
from hilsplat.base.errors import ArtifactError, HilsplatError
from hilsplat.base.files import stats_of
from hilsplat.base.lineage import sha256_of_json, visible_files
from hilsplat.base.processes import remove_leftovers
from hilsplat.base.removal import DIGEST, ENTRY, delete, is_tagged, tag

logger = logging.getLogger(__name__)

CHECKPOINTS = "gaussians"  # cache of fit checkpoints; in the others, a missing entry costs only time

CACHES = (CHECKPOINTS, "masks", "contributions", "clip", "texts", "int8")
"""Folders of entries that may be deleted."""

PROBLEM_S = 3600.0  # how long a problem found by an examination counts

FIT_DAYS = 1.0
"""Checkpoints younger than this are kept, because fits save more often and may still be running."""


def caches(folder: Path) -> dict[str, list[Path]]:
    """Map the name of each cache, a subfolder or file of `folder`, to the cache's complete entries."""
    paths = sorted(Path(folder).glob("[!.]*"))
    return {path.name: visible_files(path) if path.is_dir() else [path] for path in paths}


def size_table(folder: Path) -> str:
    """Return a text table of the cache sizes."""
    lines, total = [f"{folder}"], 0.0
    for name, files in caches(folder).items():
        size_mib = sum(stat.st_size for stat in stats_of(files).values()) / 2**20
        total += size_mib
        lines.append(f"{name:<18} {len(files):>7} files {size_mib:>9.1f} MiB")
    return "\n".join([*lines, f"{'all':<18} {'':>13} {total:>9.1f} MiB"])


def prune_cache(
    folder: Path, chosen: Sequence[str] = (), *, days: float | None = None, max_mib: float | None = None
) -> tuple[int, float]:
    """Delete unfinished files and old cache entries; return the number of entries and their size in MiB.

    Only files named like an entry (`ENTRY`), in a cache with our tag, are deleted.

    Args:
        chosen: caches to prune; if empty, all, but the checkpoints only if `days` is set.
        days: delete entries not used for this many days.
        max_mib: then delete the least recently used until the rest is at most this size.
    """
    if unknown := sorted(set(chosen) - set(CACHES)):
        raise HilsplatError(f"unknown cache: {', '.join(unknown)}", expected=f"one of {', '.join(CACHES)}")
    # The cache is in the results folder, where killed jobs leave unfinished files beside their outputs.
    remove_leftovers(folder.parent if Path(folder).name == ".cache" else folder)
    names = set(chosen or CACHES) - ({CHECKPOINTS} if days is None and not chosen else set())
    now, freed, deleted = time.time(), 0, 0
    used = stats_of(
        path
        for name, files in caches(folder).items()
        if name in names and is_tagged(folder / name)
        for path in files
        if ENTRY.fullmatch(path.relative_to(folder / name).as_posix())
    )
    oldest_first = sorted(used, key=lambda path: (used[path].st_mtime, str(path)))
    total = sum(stat.st_size for stat in used.values())
    for path in oldest_first:
        idle_days = (now - used[path].st_mtime) / 86400
        is_old = days is not None and idle_days >= days
        is_excess = max_mib is not None and total - freed > max_mib * 2**20
        is_in_use = path.parent.name == CHECKPOINTS and idle_days < FIT_DAYS
        if (is_old or is_excess) and not is_in_use:
            delete(path, re.escape(path.name))
            freed += used[path].st_size
            deleted += 1
    return deleted, freed / 2**20


class ViewCache:
    """Cache of a stage's finished views as .npz files, which a rerun uses if the stage was killed.

    Keys must cover all inputs of the result: the settings, and the digests of the image, model and code.
    Entries are not `compressed` if they are floating-point numbers, which shrink too little to benefit.
    """

    def __init__(self, folder: Path, *, compressed: bool = True) -> None:
        self.folder = Path(folder)
        self.compressed = compressed
        self.hits = 0

    def path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.npz"

    def get(self, key: str, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Return the entry, computing and storing it if it is missing or damaged."""
        arrays = self.find(key)
        if arrays is not None:
            self.hits += 1
            return arrays
        arrays = compute()
        self.put(key, arrays)
        return arrays

    def find(self, key: str) -> dict[str, np.ndarray] | None:
        """Return the entry, or None if it is missing or damaged."""
        path = self.path(key)
        if path.is_file():
            with suppress(ArtifactError):
                if arrays := read_npz(path):  # a file that ends in zeros may look like an empty archive
                    with suppress(OSError):  # another process may have pruned it
                        os.utime(path)  # last use, for pruning
                    return arrays
        return None

    def put(self, key: str, arrays: dict[str, np.ndarray]) -> None:
        """Store an entry, replacing any existing one."""
        # A power failure may truncate entries or fill them with zeros. Checksums reveal this on reading, and
        # the entry is recomputed. A flush to disk, which takes milliseconds, is therefore unnecessary.
        tag(self.folder)
        write_arrays(self.path(key), arrays, compressed=self.compressed, durable=False)


def remembered(kind: str, key: object, examine: Callable[[], str]) -> str:
    """Return the result of an examination, which is done once for each key.

    If the user's cache folder cannot be written, each process examines again.

    Args:
        kind: name of a folder of results, which `forget` clears.
        key: JSON value that changes if the result may change, such as versions of libraries.
    """
    known = recalled(kind, key)
    if known is not None:
        return known
    result = examine()
    with suppress(OSError, HilsplatError):
        write_text(_folder(kind) / sha256_of_json(key), result)
    return result


def recalled(kind: str, key: object) -> str | None:
    """Return the earlier result of `remembered`, or None.

    A problem, a result that is not empty, counts for an hour: memory, a time limit or another job may be its
    cause.
    """
    with suppress(OSError, ValueError):
        path = _folder(kind) / sha256_of_json(key)
        result = path.read_text(encoding="utf-8")
        if not result or time.time() - path.stat().st_mtime < PROBLEM_S:
            return result
    return None


def forget(kind: str) -> None:
    with suppress(OSError):
        for path in _folder(kind).iterdir():
            if re.fullmatch(DIGEST, path.name):
                delete(path, DIGEST)


def use_writable_cache() -> None:
    """Give libraries a folder for their caches in the temporary folder if the user's cannot be written.

    They would fail otherwise: numba, Snakemake and Matplotlib, in containers without a home.
    """
    try:
        getpass.getuser()
    except (KeyError, OSError):  # a user without a name; Snakemake prints it
        os.environ["LOGNAME"] = str(os.getuid())
    wanted = Path("~/.cache")
    with suppress(OSError, RuntimeError):  # RuntimeError: a user without a home
        wanted = platformdirs.user_cache_path()
        wanted.mkdir(parents=True, exist_ok=True)
        if os.access(wanted, os.W_OK):
            return
    folder = _private_folder(tempfile.gettempdir())
    os.environ["XDG_CACHE_HOME"] = os.environ["MPLCONFIGDIR"] = str(folder)
    os.environ.setdefault("HOME", str(folder))
    logger.info("%s cannot be written; caches are kept in %s", wanted, folder)


def writable(folder: Path) -> Path:
    """Return a cache folder, or if it cannot be written, one in the user's cache folder."""
    if os.access(existing_folder(folder), os.W_OK):
        return folder
    other = _folder("views")
    logger.info("%s cannot be written; its entries are kept in %s", folder, other)
    return other


def _folder(kind: str) -> Path:
    with suppress(RuntimeError):  # a user without a home
        return platformdirs.user_cache_path("hilsplat") / kind
    return _private_folder(tempfile.gettempdir()) / kind


@functools.cache
def _private_folder(temporary: str) -> Path:
    """Return a folder among the temporary files that only this user can write."""
    folder = Path(temporary) / f"hilsplat-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    stat = folder.lstat()
    is_ours = stat.st_uid == os.getuid() and not stat.st_mode & 0o022  # a link has all permissions
    return folder if is_ours else Path(tempfile.mkdtemp(prefix="hilsplat-"))
