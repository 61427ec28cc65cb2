"""Memory that this process may use: of the machine, the container or the cluster job."""

import math
import os
from pathlib import Path

from hilsplat.base.errors import MemoryLimitError

MIB = 2**20

SYSTEM = Path("/")  # parent folder of `proc` and `sys`; tests use other folders

CGROUP_FILES = {
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    2: ("memory.max", "memory.current", "inactive_file"),
}
"""Control group version -> files with memory limit and use, and key of reclaimable pages in `memory.stat`."""


def machine_mib() -> float:
    """Return the memory in MiB available to this process, on its machine, in its container or cluster job."""
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / MIB
    return min([physical, *(limit for limit, _ in _cgroups())])


def limit_mib(memory_mib: float | None) -> float:
    """Return the lower of `memory_mib` (None: no limit) and the memory available to this process."""
    return min(machine_mib(), memory_mib or math.inf)


def require_memory(needed_mib: float, memory_mib: float | None, what: str, fix: str) -> None:
    """Refuse work that needs more than `memory_mib`, or than this machine, container or cluster job has.

    Raises:
        MemoryLimitError: it does.
    """
    most_mib = limit_mib(memory_mib)
    if needed_mib > most_mib:
        raise MemoryLimitError(
            f"{what} needs more memory than it may use",
            expected=f"at least {needed_mib / 1024:.1f} GiB",
            found=f"{most_mib / 1024:.1f} GiB",
            fix=fix,
        )


def available_mib() -> float:
    """Return the memory in MiB that is currently free on the machine and in the container or cluster job."""
    try:
        lines = (SYSTEM / "proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:  # not Linux
        return machine_mib()
    (free_kib,) = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return min([int(free_kib) / 1024, *(limit - used for limit, used in _cgroups())])


def _cgroups() -> list[tuple[float, float]]:
    """Return the limit and use in MiB of each control group that contains this process and limits its memory.

    Groups are nested, and each limit applies. Reclaimable file pages do not count as used. Version 1 reports
    a limit of 8 EiB for groups without a limit.
    """
    try:
        lines = (SYSTEM / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        return []
    groups = []
    for _, controllers, path in (line.split(":", 2) for line in lines):
        if controllers and "memory" not in controllers.split(","):
            continue
        mount = SYSTEM / "sys/fs/cgroup" / ("memory" if controllers else "")
        limit_file, use_file, reclaimable = CGROUP_FILES[1 if controllers else 2]
        innermost = mount / path.lstrip("/")
        if ".." in innermost.parts or not innermost.is_dir():  # the mount is the container's own group
            innermost = mount
        for group in (innermost, *innermost.parents):
            if not group.is_relative_to(mount):
                break
            limit, used, stat = (_text(group / name) for name in (limit_file, use_file, "memory.stat"))
            if limit.isdigit():
                pages = dict(line.split() for line in stat.splitlines())
                groups.append((int(limit) / MIB, (int(used) - int(pages[reclaimable])) / MIB))
    return groups


def _text(path: Path) -> str:
    return path.read_text(encoding="ascii").strip() if path.is_file() else ""
