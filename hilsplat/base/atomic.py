"""Atomic writing, locks of outputs, and errors on a full disk."""

import errno
import json
import logging
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hilsplat.base.errors import MACHINE, ArtifactError, DiskSpaceError, HilsplatError
from hilsplat.base.processes import lock, unfinished_folder
from hilsplat.base.removal import UNFINISHED, delete, is_unfinished, replace_folder

logger = logging.getLogger(__name__)

FULL_DISK = ("No space left on device", "disk is full", "Disk quota exceeded", "requested and")
"""Parts of disk-full messages from libraries: safetensors, SQLite, NumPy ("8 requested and 0 written")."""

SYSTEM_ERROR = re.compile(r"\(os error (\d+)\)")
"""Number of a system error in a message from Rust, such as of safetensors."""

LIBRARY_ERRORS = (RuntimeError, ChildProcessError)
"""Exceptions raised by C++ libraries, or because a library terminated its process."""

NO_FLUSH = (errno.EINVAL, errno.EBADF, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of file systems that cannot flush folders, such as 9p and some of FUSE."""

FULL_BELOW_MIB = 1.0
"""Free space below which `LIBRARY_ERRORS` are attributed to a full disk, which COLMAP does not report."""


@contextmanager
def atomic_path(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary file that replaces `path` when the block ends without error.

    A `durable` file is flushed to disk, to survive a power failure. A full disk raises DiskSpaceError.
    """
    path = Path(path)
    if is_unfinished(path):  # the file is in a hidden folder that is flushed to the disk later
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with explain_full_disk(path), _keep_mode(path, path):
                yield path
        except BaseException:
            delete(path)
            raise
        return
    with work_folder(path) as folder:
        temporary = folder / f"new{path.suffix[-16:]}"
        with _keep_mode(temporary, path):
            yield temporary
        if durable:
            _flush(temporary)
        temporary.replace(path)
        if durable:
            _flush_replaced(path)


@contextmanager
def _keep_mode(temporary: Path, path: Path) -> Iterator[None]:
    """Create a file with the mode of `path` or, if that is new, the umask's; safetensors would set 0600."""
    temporary.touch()
    mode = (path if path.exists() else temporary).stat().st_mode & 0o777
    yield
    if temporary.stat().st_mode & 0o777 != mode:  # file systems without modes refuse any change
        temporary.chmod(mode)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces `path` at the end; raise DiskSpaceError if the disk is full."""
    path = Path(path)
    durable = not is_unfinished(path)
    with work_folder(path) as folder:
        temporary = folder / "new"
        temporary.mkdir()
        yield temporary
        if durable:
            for parent, _, names in os.walk(temporary, topdown=False):
                for name in names:
                    _flush(Path(parent, name))
                _flush(Path(parent))
        replace_folder(temporary, path, folder)
        if durable:
            _flush_replaced(path)


@contextmanager
def work_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, deleted at the end; raise DiskSpaceError on a full disk."""
    path = Path(path)
    with explain_full_disk(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished_folder(path.parent) as folder, explain_full_disk(path):
            yield folder


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in NO_FLUSH:
            raise
    finally:
        os.close(descriptor)


def _flush_replaced(path: Path) -> None:
    """Flush the folder of a replaced path; an error is only logged, because the new version is in place."""
    try:
        _flush(path.parent)
    except OSError as error:
        logger.warning("%s was written, but a power failure may undo this: %s", path, error.strerror)


@contextmanager
def explain_full_disk(path: Path) -> Iterator[None]:
    """Raise DiskSpaceError, naming the disk and a fix, if writing `path` fails because the disk is full."""
    try:
        yield
    except HilsplatError:
        raise
    except Exception as error:
        hidden = [parent for parent in path.parents if UNFINISHED.fullmatch(parent.name)]
        folder = existing_folder(hidden[-1].parent if hidden else path.parent)
        usage = shutil.disk_usage(folder)
        of_rust = SYSTEM_ERROR.search(str(error))
        number = int(of_rust[1]) if of_rust else getattr(error, "errno", None)
        full = number in (errno.ENOSPC, errno.EDQUOT) or any(words in str(error) for words in FULL_DISK)
        full = full or (isinstance(error, LIBRARY_ERRORS) and usage.free < FULL_BELOW_MIB * 2**20)
        if full:
            raise DiskSpaceError(
                f"no space left while writing {path.name} in {folder}",
                found=f"{usage.free / 2**20:.1f} MiB free of {usage.total / 2**20:.0f} MiB on that disk"
                + ", which cannot hold more files (inodes)" * _lacks_inodes(folder),
                fix=f"free up space on the disk of {folder}, then run again; finished work is kept",
            ) from error
        if isinstance(error, OSError) and is_unfinished(Path(str(error.filename))):
            error.filename = str(path)  # a temporary name means nothing to a user
        elif isinstance(error, OSError) and error.filename is None and error.errno in MACHINE:
            error.filename = f"{path}, or a file that it is made from,"
        elif number is not None and not isinstance(error, OSError):
            raise OSError(number, os.strerror(number), str(path)) from error
        raise


def _lacks_inodes(folder: Path) -> bool:
    if not hasattr(os, "statvfs"):  # Windows
        return False
    stat = os.statvfs(folder)
    return stat.f_files > 0 and stat.f_favail == 0


def existing_folder(folder: Path) -> Path:
    """Return the folder, or its nearest existing parent."""
    return next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())


def require_free_space(folder: Path, needed_mib: float) -> None:
    """Raise DiskSpaceError if less than `needed_mib` MiB is free on the folder's disk."""
    folder = existing_folder(Path(folder))
    free_mib = shutil.disk_usage(folder).free / 2**20
    if free_mib < needed_mib:
        raise DiskSpaceError(
            f"not enough space on the disk of {folder}",
            expected=f"at least {needed_mib:.0f} MiB free",
            found=f"{free_mib:.0f} MiB free",
            fix="free up space, or move the folder to another disk and replace it with a symbolic link",
        )


@contextmanager
def output_lock(output: Path, *beside: Path) -> Iterator[None]:
    """Lock an output for writing; raise ArtifactError if another process is writing it.

    If a writer fails or is killed, its lock file stays non-empty, because the output may then match
    neither the provenance record nor the inputs of that writer. It lists the files `beside` the output.
    """
    output = Path(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    with lock_path(output).open("a") as stream:
        try:
            lock(stream, wait=False)
        except BlockingIOError as error:
            raise ArtifactError(
                f"another process is writing {output}", fix="let it finish or stop it, then run again"
            ) from error
        stream.truncate(0)
        json.dump([os.path.relpath(path, output.parent) for path in beside], stream)
        stream.flush()
        yield
        stream.truncate(0)


@contextmanager
def changing(path: Path) -> Iterator[Path]:
    """Wait for the lock of a file that is read, changed and written; yield the file, or where it links to."""
    path = Path(os.path.realpath(path))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = lock_path(path).open("a")
    except OSError as error:
        error.filename = str(path)  # the name of the lock means nothing to a user
        raise
    with stream:
        try:
            lock(stream, wait=False)
        except BlockingIOError:
            logger.info("waiting for another command that changes %s", path)
            lock(stream)
        yield path


def lock_path(output: Path) -> Path:
    return output.parent / f".{output.name}.lock"


def was_interrupted(output: Path) -> bool:
    """Return whether the last writer of an output was killed or failed."""
    try:
        return lock_path(output).stat().st_size > 0
    except OSError:
        return False


def interrupted_outputs(output: Path) -> set[Path]:
    """Return the output and the files beside it if their last writer was killed or failed, else nothing."""
    if not was_interrupted(output):
        return set()
    outputs = {output.resolve()}
    with suppress(OSError, TypeError, ValueError):  # it was cut by a full disk, or is not ours
        names = json.loads(lock_path(output).read_text(encoding="utf-8"))
        outputs |= {(output.parent / name).resolve() for name in names}
    return outputs
