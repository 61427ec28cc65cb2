"""Advisory locks of files, which end with the process that holds them."""

from typing import IO, Any

from hilsplat.base.errors import HilsplatError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


def lock(stream: IO[Any], *, shared: bool = False, wait: bool = True) -> None:
    """Lock an open file until it is closed.

    Raises:
        BlockingIOError: another process has locked it, and `wait` is false.
        HilsplatError: this operating system has no such locks.
    """
    if fcntl is None:
        raise HilsplatError(
            "hilsplat cannot lock files on this operating system",
            expected="Linux, macOS, or Windows Subsystem for Linux",
            fix="run hilsplat in WSL: https://learn.microsoft.com/windows/wsl",
        )
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    fcntl.flock(stream, kind if wait else kind | fcntl.LOCK_NB)
