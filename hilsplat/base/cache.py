"""Cache sizes, and pruning of finished views and checkpoints."""

import time
from pathlib import Path

from hilsplat.base.artifacts import visible_files
from hilsplat.base.errors import HilsplatError
from hilsplat.base.processes import remove_leftovers

VIEW_CACHES = ("masks", "clip", "contributions")
"""Caches of finished views: a missing entry costs time but does not change a result."""

CHECKPOINTS = "gaussians"  # cache of fit checkpoints
FIT_DAYS = 1.0
"""Checkpoints younger than this are kept, because fits save more often and may still be running."""


def caches(folder: Path) -> dict[str, list[Path]]:
    """Map the name of each cache, a subfolder or file of `folder`, to the cache's complete entries."""
    places = sorted(Path(folder).glob("[!.]*"))
    return {place.name: visible_files(place) if place.is_dir() else [place] for place in places}


def size_table(folder: Path) -> str:
    """Return a text table of the cache sizes."""
    lines, total = [f"{folder}"], 0.0
    for name, files in caches(folder).items():
        size_mib = sum(path.stat().st_size for path in files) / 2**20
        total += size_mib
        lines.append(f"{name:<14} {len(files):>7} files {size_mib:>9.1f} MiB")
    return "\n".join([*lines, f"{'all':<14} {'':>13} {total:>9.1f} MiB"])


def prune_cache(
    folder: Path, stages: list[str], *, days: float | None = None, max_mib: float | None = None
) -> tuple[int, float]:
    """Delete unfinished files and old cache entries; return the number of entries and their size in MiB.

    Args:
        stages: caches to prune; if empty, the view caches, and also the checkpoints if `days` is set.
        days: delete entries not used for this many days.
        max_mib: then delete the least recently used until the rest is at most this size.
    """
    known = (*VIEW_CACHES, CHECKPOINTS)
    if unknown := sorted(set(stages) - set(known)):
        raise HilsplatError(f"unknown cache: {', '.join(unknown)}", expected=f"one of {', '.join(known)}")
    # The cache is in the results folder, where killed jobs leave unfinished files beside their outputs.
    remove_leftovers(folder.parent if Path(folder).name == ".cache" else folder)
    chosen = set(stages or (VIEW_CACHES if days is None else known))
    now, freed, deleted = time.time(), 0, 0
    used = {path: path.stat() for name, files in caches(folder).items() if name in chosen for path in files}
    oldest_first = sorted(used, key=lambda path: (used[path].st_mtime, str(path)))
    total = sum(stat.st_size for stat in used.values())
    for path in oldest_first:
        idle_days = (now - used[path].st_mtime) / 86400
        old = days is not None and idle_days >= days
        much = max_mib is not None and total - freed > max_mib * 2**20
        if (old or much) and not (path.parent.name == CHECKPOINTS and idle_days < FIT_DAYS):
            path.unlink(missing_ok=True)
            freed += used[path].st_size
            deleted += 1
    return deleted, freed / 2**20
