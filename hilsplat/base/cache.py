"""Sizes of the caches of finished views, and their pruning."""

import time
from dataclasses import dataclass
from pathlib import Path

from hilsplat.base.errors import HilsplatError
from hilsplat.base.processes import remove_litter

VIEW_CACHES = ("masks", "clip", "contributions")
"""Caches that can be pruned: a missing entry costs time, never a result."""


@dataclass(frozen=True)
class Entries:
    """Files of one cache.

    Attributes:
        name: of its folder.
        files: complete entries, without those still being written.
        size_mib: of all of them.
    """

    name: str
    files: tuple[Path, ...]
    size_mib: float


def _mib(files: tuple[Path, ...]) -> float:
    return sum(path.stat().st_size for path in files) / 2**20


def caches(folder: Path) -> list[Entries]:
    """The caches under a cache folder, by name."""
    found = []
    for cache in sorted(path for path in Path(folder).glob("*") if path.is_dir()):
        files = tuple(
            sorted(path for path in cache.rglob("*") if path.is_file() and not path.name.startswith("."))
        )
        found.append(Entries(cache.name, files, _mib(files)))
    return found


def size_table(folder: Path) -> str:
    """Size of each cache as text."""
    found = caches(folder)
    lines = [f"{cache.name:<14} {len(cache.files):>7} files {cache.size_mib:>9.1f} MiB" for cache in found]
    total = sum(cache.size_mib for cache in found)
    return "\n".join([f"{folder}", *lines, f"{'all':<14} {'':>13} {total:>9.1f} MiB"])


def prune_cache(
    folder: Path, stages: list[str], *, days: float | None = None, max_mib: float | None = None
) -> tuple[int, float]:
    """Delete what killed jobs left unfinished, and entries of view caches, the least recently used first.

    Args:
        folder: cache folder.
        stages: which of `VIEW_CACHES`; empty: all of them.
        days: delete entries not used for this many days.
        max_mib: then delete entries until at most this much is left. Without either limit no entry goes.

    Returns:
        files deleted, and their size in MiB.

    Raises:
        HilsplatError: a stage has no view cache.
    """
    strangers = sorted(set(stages) - set(VIEW_CACHES))
    if strangers:
        raise HilsplatError(
            f"there is no cache of finished views for {', '.join(strangers)}",
            expected=f"one of {', '.join(VIEW_CACHES)}",
        )
    # the caches lie in the results folder, whose stages leave theirs beside their outputs
    remove_litter(folder.parent if Path(folder).name == ".cache" else folder)
    chosen = set(stages or VIEW_CACHES)
    files = [path for cache in caches(folder) if cache.name in chosen for path in cache.files]
    used = {path: path.stat() for path in files}
    oldest_first = sorted(files, key=lambda path: (used[path].st_mtime, str(path)))
    total = sum(stat.st_size for stat in used.values())
    now, freed, deleted = time.time(), 0, 0
    for path in oldest_first:
        old = days is not None and now - used[path].st_mtime >= days * 86400
        much = max_mib is not None and total - freed > max_mib * 2**20
        if old or much:
            path.unlink(missing_ok=True)
            freed += used[path].st_size
            deleted += 1
    return deleted, freed / 2**20
