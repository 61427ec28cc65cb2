"""Deletion and replacement: no other module deletes, and of all others only `atomic_path` renames.

Nothing is deleted because of its place alone. A name must have a form that only hilsplat gives, a folder of
entries must contain our tag, and clean-up deletes only what the same call created. A test looks for calls
elsewhere (tests/unit/base/test_removal.py).
"""

import ctypes
import errno
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hilsplat.base.files import files_below

UNFINISHED = re.compile(r"\.writing-(?P<host>[0-9a-f]{8})-[0-9a-f]{8}")
"""Name of a folder of unfinished files; it is hidden, so digests ignore it."""

LOCK = ".lock"  # file in such a folder; its writer locks it
FORMER = ".former"  # subfolder of such a folder for the version that is being replaced

DIGEST = "[0-9a-f]{64}"
ENTRY = re.compile(
    rf"[0-9a-f]{{2}}/{DIGEST}\.npz|partial/{DIGEST}/(index\.json|\w+\.npy)|[0-9a-f]{{16}}\.npz"
)
"""Path of an entry in its cache: a view, part of a checkpoint of contributions, or a checkpoint of a fit."""

TAG = "CACHEDIR.TAG"
TAG_TEXT = """Signature: 8a477f597d28d172789f06886806bc55
# hilsplat wrote the entries of this folder, and may delete them. See https://bford.info/cachedir/
"""


def is_unfinished(path: Path) -> bool:
    """Return whether a path is a folder of unfinished files or inside one."""
    return any(UNFINISHED.fullmatch(part) for part in Path(path).parts)


def delete(path: Path, form: str = "") -> None:
    """Delete a file, link or folder if it exists; its name must match `form` unless it is unfinished."""
    if not (is_unfinished(path) or re.fullmatch(form, path.name)):
        raise ValueError(f"{path} may not be deleted: its name does not have the form {form}")
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def tag(folder: Path) -> None:
    """Create a folder whose entries hilsplat may delete; one with other files is never tagged."""
    files = (path for path in files_below(folder) if not is_unfinished(path))
    if is_tagged(folder) or not all(ENTRY.fullmatch(path.relative_to(folder).as_posix()) for path in files):
        return
    folder.mkdir(parents=True, exist_ok=True)
    try:
        (folder / TAG).write_text(TAG_TEXT, encoding="utf-8")
    except OSError:  # a full disk
        (folder / TAG).unlink(missing_ok=True)
        raise


def is_tagged(folder: Path) -> bool:
    with suppress(OSError, ValueError):
        return (folder / TAG).read_text(encoding="utf-8") == TAG_TEXT
    return False


@contextmanager
def undone_on_error(folder: Path) -> Iterator[None]:
    """Delete the present files of a new folder if the block fails or is interrupted, and keep later ones."""
    created = list(folder.rglob("*"))
    try:
        yield
    except BaseException:
        for path in sorted([folder, *created], reverse=True):
            with suppress(OSError):  # a folder that contains other files
                path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
        raise


def replace_folder(new: Path, path: Path, work: Path) -> None:
    """Rename a folder to `path`; the former version, a file or folder, is left in the folder `work`."""
    if not os.path.lexists(path):
        new.rename(path)
    elif not _exchange(new, path):
        (work / FORMER).mkdir()
        path.rename(work / FORMER / path.name)
        new.rename(path)


def discard(folder: Path) -> None:
    """Delete a folder of unfinished files after restoring any former version that was not replaced."""
    former = folder / FORMER
    if former.is_dir():
        for version in former.iterdir():
            if not os.path.lexists(folder.parent / version.name):
                version.rename(folder.parent / version.name)
        former.rename(folder / "old")  # a partly deleted version must never be restored
    for path in folder.iterdir():
        if path.name != LOCK:  # it is deleted last, because it shows that the rest is ours
            delete(path)
    delete(folder)


_libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None
_renameat2 = getattr(_libc, "renameat2", None)
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # from Linux's <stdio.h>, <fcntl.h> and <linux/fs.h>


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two paths atomically; return False if the operating or file system does not support this."""
    if _renameat2 is None:
        return False
    if _renameat2(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP):
        return False
    raise OSError(code, os.strerror(code), str(other))
