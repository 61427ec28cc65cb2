"""Errors that a user can fix."""

import difflib
import errno
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


class HilsplatError(Exception):
    """Error caused by a file, a setting or a user; commands print no traceback and exit with status 1.

    The message is one sentence that names the file, scene, view or key.
    """

    def __init__(
        self, message: str, *, expected: object = None, found: object = None, fix: str | None = None
    ) -> None:
        super().__init__(message)
        for name, value in (("expected", expected), ("found", found), ("fix", fix)):
            if value is not None:
                self.add_line(name, value)

    def add_line(self, name: str, value: object) -> None:
        """Append a line, such as `found`."""
        self.args = (f"{self}\n  {name:<9} {value}",)


def system_error(error: BaseException) -> HilsplatError | None:
    """Convert a system error that a user can fix into a `HilsplatError`; return None for any other error.

    An error about content (`OF_CONTENT`) gets another fix if the machine, not the content, is the reason.
    """
    if isinstance(error, HilsplatError):
        cause = error.__cause__
        while isinstance(cause, HilsplatError):
            cause = cause.__cause__
        number = cause.errno if isinstance(cause, OSError) else None
        if isinstance(error, OF_CONTENT) and number in MACHINE:
            fix = f"the file may be intact, but it {MACHINE[number]}: correct this, then run again"
            return type(error)(str(error).partition("\n")[0], fix=fix)
        return error
    is_limited = resource is not None and resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY
    by_library = NO_THREAD in str(error) or (is_limited and any(words in str(error) for words in NO_MEMORY))
    if isinstance(error, MemoryError) or by_library:
        return HilsplatError(
            f"there is not enough memory, or too few threads are allowed: {error or 'an allocation failed'}",
            fix="close other programs, raise the limits (ulimit -v and -u, or those of a container), or use "
            "smaller or fewer images",
        )
    if not isinstance(error, OSError) or error.errno is None:
        return None
    problem = (MACHINE | PLACES).get(error.errno, "cannot be read or written")
    path = Path(error.filename or "")
    if error.errno == errno.EEXIST and path.is_symlink() and not path.exists():
        problem = f"is a link to {path.readlink()}, which is missing; its disk may not be mounted"
    return HilsplatError(
        f"{error.filename or 'standard output or an open file'} {problem}",
        found=error.strerror,
        fix="correct the problem, or choose a different path",
    )


def is_interruption(error: BaseException | None) -> bool:
    """Return whether Ctrl-C caused an error: a library that is being imported raises its own instead."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


KILLED = "probably because memory ran out"
KILLED_FIX = "use fewer cores (hilsplat run --cores 1), smaller images (poses.max_side_px) or more memory"


def visible(text: object) -> str:
    """Escape unprintable characters except line breaks and tabs, because terminals may obey them."""
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in str(text))


def first_line(error: object) -> str:
    """Return the first line of an error from elsewhere, without unprintable characters, or its type."""
    if isinstance(error, ValueError) and hasattr(error, "errors"):  # of pydantic
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        return ": ".join(filter(None, [".".join(map(str, first["loc"])), first["msg"]]))
    lines = str(error)[:1000].strip().splitlines() or [type(error).__name__]
    return "".join(letter for letter in lines[0] if letter.isprintable())[:200]


def in_one_line(error: HilsplatError) -> str:
    """Return an error's message and lines as one line."""
    return "; ".join(" ".join(line.split()) for line in str(error).splitlines())


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name that was probably meant or, if none is similar, the first known names.

    Names such as `photos/desk` are also compared by their last parts.
    """
    names = list(known)
    parts = {part: full for full in names for part in (full.rpartition("/")[2], full)}
    for part in (name, name.rpartition("/")[2]):
        if near := difflib.get_close_matches(part, parts, n=1):
            return f"did you mean {parts[near[0]]!r}?"
    return f"one of {shorten_list(names, 12)}"


def shorten_list(names: Sequence[str], count: int = 3) -> str:
    """Return the first names, and the number of remaining names."""
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return ", ".join(names[:count]) + more


def require_working_directory() -> None:
    """Raise HilsplatError if the working directory was deleted."""
    try:
        Path.cwd()
    except FileNotFoundError:
        raise HilsplatError(
            "the working directory was deleted", fix="change to an existing folder, then run again"
        ) from None


NO_THREAD = "can't start new thread"
NO_MEMORY = ("failed to map segment", "Could not find/load shared object")
"""Parts of error messages that appear if `ulimit -v` keeps a library from loading."""

MACHINE = {
    errno.EACCES: "cannot be read or written: permission denied",
    errno.EPERM: "cannot be read or written: permission denied",
    errno.EROFS: "is on a read-only disk",
    errno.EAGAIN: "needs more processes than allowed (ulimit -u, or the limit of a container)",
    errno.EMFILE: "cannot be opened: too many files are open (ulimit -n)",
    errno.ENFILE: "cannot be opened: too many files are open on this machine",
    errno.EFBIG: "would exceed the size limit of this shell (ulimit -f) or of the file system",
    errno.EIO: "cannot be read or written: the disk reported an error",
    errno.ESTALE: "cannot be read or written: the network disk has lost it",
    errno.ENOLCK: "cannot be locked: the network disk has no lock service",
    errno.ENOSYS: "cannot be locked: mount its disk with locks, Lustre with the option flock",
    errno.EOPNOTSUPP: "cannot be locked: mount its disk with locks, Lustre with the option flock",
    errno.ENOSPC: "cannot be written: the disk is full",
    errno.EDQUOT: "exceeds your disk quota",
}
"""System error number -> problem with the machine, whatever the path and content."""

PLACES = {
    errno.ENOENT: "is missing or cannot be created",
    errno.ENOTDIR: "cannot be opened or created: part of the path is a file",
    errno.EISDIR: "is a folder; a file is expected",
    errno.EEXIST: "already exists",
    errno.ELOOP: "is a symbolic link that points back to itself",
    errno.ENAMETOOLONG: "is too long for this file system",
}
"""System error number -> problem with the path."""


class SettingsError(HilsplatError):
    """A key is unknown, or a value has the wrong type or is out of range."""


class SceneError(HilsplatError):
    """A row of the scene sheet, or a scene folder, cannot be used."""


class ImageError(HilsplatError):
    """An image is missing, empty, truncated, unreadable or of the wrong size."""


class RegistrationError(HilsplatError):
    """Structure from motion registered too few views."""


class ModelError(HilsplatError):
    """A model folder is missing, incomplete or of the wrong kind."""


class DownloadError(HilsplatError):
    """A model cannot be downloaded: the hub is unreachable, denies access, or sent a wrong file."""


class ArtifactError(HilsplatError):
    """A stage's output is missing, incomplete, damaged or made from different inputs."""


class MisalignedArtifactError(ArtifactError):
    """Two artifacts do not belong together: their rows, sizes or digests differ."""


OF_CONTENT = (ArtifactError, ImageError, ModelError, SceneError)  # errors about a file's content


class DiskSpaceError(HilsplatError):
    """The disk is full, or has too little free space for a stage's output."""


class MemoryLimitError(HilsplatError):
    """A stage needs more memory than it may use."""


class DeviceError(HilsplatError):
    """This machine does not have the device selected in the settings."""


def require_kind(value: object, kind: type, fix: str) -> None:
    """Raise SettingsError unless an argument of a Python function is a `kind`."""
    if not isinstance(value, kind):
        found = f"{type(value).__name__} {str(value)[:80]}"
        raise SettingsError("an argument has the wrong type", expected=kind.__name__, found=found, fix=fix)


@contextmanager
def foreign(
    what: object,
    error: type[HilsplatError] = SceneError,
    *,
    problem: str = "cannot be read",
    expected: object = None,
    fix: str | Callable[[], str] = "export it again",
) -> Iterator[None]:
    """Turn every exception of a block that parses another program's data into `error`, which names `what`.

    Parsers raise nearly every exception on damaged data, so types aren't listed. Errors of ours pass.
    """
    try:
        yield
    except HilsplatError:
        raise
    except Exception as cause:
        reason = f"{first_line(cause)} is missing" if isinstance(cause, KeyError) else first_line(cause)
        problem = f"{what} {problem}: {reason}"
        if isinstance(cause, FileNotFoundError) and str(what).endswith(str(cause.filename)):
            problem, expected = f"{what} is missing", None
        raise error(problem, expected=expected, fix=fix if isinstance(fix, str) else fix()) from cause
