"""Child processes that end with their parent, locks, unfinished files, state of the process, and pools."""

import ctypes
import functools
import hashlib
import logging
import os
import secrets
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from threading import Lock, Thread
from typing import IO, Any, TypeVar

from hilsplat.base.errors import KILLED, KILLED_FIX, HilsplatError
from hilsplat.base.removal import LOCK, UNFINISHED, delete, discard

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Item = TypeVar("Item")
Result = TypeVar("Result")

logger = logging.getLogger(__name__)

PARENT = "HILSPLAT_PARENT"
"""Environment variable with host and id of the Snakemake process; jobs end with it (workflow/run.py)."""

PR_SET_PDEATHSIG = 1  # from Linux's <sys/prctl.h>
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # from glibc's <malloc.h>


def end_with_parent(parent: int) -> None:
    """Kill this process as soon as the process that started it ends for any reason.

    Otherwise, jobs of a killed Snakemake process would continue, and write outputs with old settings during
    the next run. Linux kills the process unless a shell is in between; then, a thread checks every second.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if not is_alive(parent):  # it ended before prctl was called
        os._exit(1)
    if sys.platform != "linux" or os.getppid() != parent:
        Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    with suppress(OSError, AttributeError):  # without pidfd, or already gone
        select.select([os.pidfd_open(parent)], [], [])  # also if its parent doesn't await it
        os._exit(1)
    while is_alive(parent):
        time.sleep(1)
    os._exit(1)


def parent_variable() -> dict[str, str]:
    """Return the environment variable with which jobs end with this process."""
    return {PARENT: f"{host_token()}:{os.getpid()}"}


def end_with_workflow() -> None:
    """End this process with the Snakemake process that started it, if any.

    A cluster passes the variable to jobs on other hosts, where the number means another process or none.
    """
    host, _, parent = os.environ.pop(PARENT, "").partition(":")  # this process's children have another parent
    if host == host_token() and parent.isdecimal():
        end_with_parent(int(parent))


def keep_freed_memory() -> None:
    """Let glibc keep up to 128 MiB of freed memory for later arrays instead of returning it to the system.

    Otherwise, the system clears new pages for most arrays of a step, which takes up to a fifth of a step of
    a fit. Arrays above 32 MiB are still returned at once, so that large scenes take no more memory.
    """
    if sys.platform == "linux":
        with suppress(AttributeError):  # another C library
            set_option = ctypes.CDLL(None).mallopt
            set_option(M_MMAP_THRESHOLD, 32 << 20)
            set_option(M_TRIM_THRESHOLD, 128 << 20)


class Shared:
    """A context that changes the state of the process, for calls that overlap in several threads.

    The first call enters it, and the last one leaves it. If each call saved and restored the state itself,
    a later call would restore the changed state of an earlier one.
    """

    def __init__(self, context: Callable[[], AbstractContextManager[Any]]) -> None:
        self._context, self._lock, self._calls, self._stack = context, Lock(), 0, ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            if self._calls == 0:
                self._stack.enter_context(self._context())
            self._calls += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._calls -= 1
            if self._calls == 0:
                self._stack.close()


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
    try:
        fcntl.flock(stream, kind if wait else kind | fcntl.LOCK_NB)
    except OSError as error:
        error.filename = stream.name
        raise


@functools.cache
def host_token() -> str:
    """Return eight hexadecimal digits that identify this host by name; a reboot does not change the name."""
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


@functools.cache
def boot_id() -> str:
    """Return what identifies this start of this machine, also in its containers; empty if unknown."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return ""


def num_cores() -> int:
    """Return the number of cores that this process may use, by its affinity and a container's quota."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with suppress(OSError, ValueError):  # ValueError: "max"
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        cores = min(cores, max(1, round(int(quota) / int(period))))
    return cores


@contextmanager
def unfinished_folder(parent: Path) -> Iterator[Path]:
    """Create a folder for unfinished files, and delete it at the end; first delete those of killed processes.

    A locked file in it shows `remove_leftovers` that the writer is alive: the system releases the lock when
    the writer ends, even if it is killed. Process ids have no meaning in other containers or after a reboot.
    The folder itself is not locked, because NFS can lock only files.
    """
    is_locked = False
    for path in Path(parent).glob(f".writing-{host_token()}-*"):
        _is_removed(path)
    while not is_locked:
        folder = Path(parent) / f".writing-{host_token()}-{secrets.token_hex(4)}"
        folder.mkdir()
        try:
            stream = (folder / LOCK).open("ab")
            lock(stream)
            with suppress(OSError):  # a full disk
                stream.write(boot_id().encode())
                stream.flush()
            is_locked = os.fstat(stream.fileno()).st_nlink > 0
        except BaseException as error:
            delete(folder)
            if not isinstance(error, FileNotFoundError):  # a clean-up deleted the folder before it was locked
                raise
    try:
        yield folder
    finally:
        _discard(folder, stream)


def _discard(folder: Path, lock: IO[bytes]) -> None:
    discard(folder)
    lock.close()
    delete(folder)  # NFS keeps a deleted file until it is closed


def remove_leftovers(folder: Path) -> list[Path]:
    """Delete unfinished files left in a folder by dead processes on this host; return the deleted folders."""
    removed = []
    for parent, folders, _ in os.walk(folder):
        removed += [path for name in folders if _is_removed(path := Path(parent, name))]
        folders[:] = [name for name in folders if not UNFINISHED.fullmatch(name)]
    if removed:
        logger.info("deleted the unfinished files of %d killed jobs", len(removed))
    return removed


def _is_removed(path: Path) -> bool:
    """Delete a folder of unfinished files unless its writer is alive; return whether it was deleted.

    Files of live processes, including those in other containers, are kept. If the folder is shared, files
    from other hosts are also kept, because their locks may be invisible here; containers on one machine may
    have other host names. A folder without a lock is not ours, unless it is empty.
    """
    match = UNFINISHED.fullmatch(path.name)
    if match is None or path.is_symlink():
        return False
    with suppress(OSError):
        if match["host"] != host_token() and (path / LOCK).read_bytes() != (boot_id() or "?").encode():
            return False
        is_new = not any(path.iterdir())  # its writer may be about to create the lock
        with (path / LOCK).open("ab" if is_new else "rb+") as stream:
            lock(stream, wait=False)
            _discard(path, stream)
        return True
    return False


def is_alive(pid: int) -> bool:
    """Return whether a process with this id exists."""
    try:
        with suppress(PermissionError):
            os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def in_processes(
    work: Callable[..., Result], items: Sequence[tuple[Any, ...]], workers: int, chunk: int = 1
) -> Iterator[Result]:
    """Yield the results of `work(*item)` in the order of `items`, computed in several processes.

    Use this for work that holds the GIL. Processes are spawned, because forking a process with threads may
    hang. `work` must be a module-level function or a `functools.partial` of one. A process takes `chunk`
    items at a time. With one worker or one item, no process is started.
    """
    if workers <= 1 or len(items) <= 1:
        for item in items:
            yield work(*item)
        return
    from concurrent.futures import ProcessPoolExecutor  # imported late: most commands need no pool
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    context, how = get_context("spawn"), (end_with_parent, (os.getpid(),))
    try:
        pool = ProcessPoolExecutor(min(workers, len(items)), context, *how)
    except OSError as error:
        fix = "mount a writable /dev/shm, or use one core: hilsplat run --cores 1"
        raise HilsplatError(f"no second process can be started: {error.strerror}", fix=fix) from error
    try:
        with pool:
            yield from pool.map(work, *zip(*items, strict=True), chunksize=chunk)
    except BrokenProcessPool as error:
        raise HilsplatError(f"a process of {work} was killed, {KILLED}", fix=KILLED_FIX) from error


OWN_PROCESS = """
import sys
sys.path += [entry for entry in sys.argv[2:] if entry not in sys.path]
from hilsplat.base.processes import run_alone
run_alone(int(sys.argv[1]))
"""


def in_own_process(work: Callable[..., Result], *arguments: Any) -> Result:
    """Return `work(*arguments)`, computed in a separate process that a library may terminate.

    Processes of `multiprocessing` would run a user's script again unless it has a guard, and leave a process
    that delays the end of a notebook's kernel, which is then killed before it can delete temporary files.

    Raises:
        ChildProcessError: the process ended without a result; the message contains the last 2000 characters
            of its stderr, which is otherwise not shown.
    """
    from multiprocessing.reduction import ForkingPickler  # imported late: most commands need no process

    command = [sys.executable, "-P", "-c", OWN_PROCESS, str(os.getpid()), *sys.path]
    call = bytes(ForkingPickler.dumps((work, arguments)))
    done = subprocess.run(command, input=call, capture_output=True, check=False)
    if done.returncode or not done.stdout:
        last = done.stderr[-2000:].decode(errors="replace")
        name = f"{work.__module__}.{work.__name__}"
        raise ChildProcessError(f"{name} was terminated by a library\n{last}")
    result, error = ForkingPickler.loads(done.stdout)
    if error is not None:
        raise error
    return result


def run_alone(parent: int) -> None:
    """Read a call from stdin, and write its result and its exception to stdout."""
    from multiprocessing.reduction import ForkingPickler

    end_with_parent(parent)
    answer = os.dup(1)
    os.dup2(2, 1)  # libraries may print
    work, arguments = ForkingPickler.loads(sys.stdin.buffer.read())
    result, error = None, None
    try:
        result = work(*arguments)
    except Exception as raised:
        error = raised
    with os.fdopen(answer, "wb") as stream:
        stream.write(ForkingPickler.dumps((result, error)))


def in_order(work: Callable[[Item], Result], items: Sequence[Item], threads: int) -> Iterator[Result]:
    """Yield the results of `work` in the order of `items`, computed by up to `threads` threads.

    At most `2 * threads` results are pending. If an item fails, items not yet started are cancelled. Under a
    debugger, items are computed in the calling thread.
    """
    if sys.gettrace() is not None:  # debuggers stop only at breakpoints in this thread
        yield from map(work, items)
        return
    threads = max(1, threads)
    with ThreadPoolExecutor(max_workers=threads) as pool:
        waiting: list[Future[Result]] = []
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) >= 2 * threads:
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
