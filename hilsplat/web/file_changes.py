"""Detection of files that changed on disk since they were opened or read."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hilsplat.base.artifacts import INDEX, output_lock, sha256_of_bytes
from hilsplat.base.errors import ArtifactError

State = tuple[int, int, int] | None


class StaleSceneError(ArtifactError):
    """A part of the scene was rewritten since it was opened."""


class StaleFileError(ArtifactError):
    """A file changed since the version that is to be replaced was read."""


NO_FILE = "none"
"""Version of a file that does not exist."""


def version_of(path: Path) -> str:
    """Return the digest of a file, which a page must send to replace it."""
    return sha256_of_bytes(path.read_bytes())[:16] if path.is_file() else NO_FILE


@contextmanager
def replacing(path: Path, version: str, what: str) -> Iterator[None]:
    """Lock a file while its user-given content, named by `what`, is replaced.

    Raises:
        StaleFileError: the file changed since `version` was read.
    """
    with output_lock(path):
        if version_of(path) != version:
            raise StaleFileError(
                f"{what} have changed since they were read", fix="reload the page, then change them"
            )
        yield


class FileChanges:
    """States of artifacts from before they were opened.

    Writers always replace the whole file, so `stat` detects a rewritten file without reading it. A folder's
    state is that of its index, which is written last.
    """

    def __init__(self) -> None:
        self._seen: dict[Path, State] = {}

    def note(self, paths: Iterable[Path]) -> None:
        """Record the current state of artifacts, except those recorded before."""
        for path in paths:
            self._seen.setdefault(Path(path), _state(Path(path)))

    def changed(self) -> list[Path]:
        """Return the recorded artifacts that changed or were deleted."""
        return [path for path, seen in self._seen.items() if _state(path) != seen]

    @contextmanager
    def unchanged(self, scene: str, *parts: Path) -> Iterator[None]:
        """Guard disk reads: fail if parts of a scene, by default all recorded ones, were rewritten.

        Raises:
            StaleSceneError: a part was rewritten before or during the read.
        """
        self._require_unchanged(scene, parts)
        yield
        self._require_unchanged(scene, parts)

    def _require_unchanged(self, scene: str, parts: tuple[Path, ...]) -> None:
        if changed := sorted(path.name for path in self.changed() if not parts or path in parts):
            raise StaleSceneError(
                f"{', '.join(changed)} of {scene} changed on the disk since the page was loaded",
                fix="reload the page",
            )


def _state(path: Path) -> State:
    try:
        found = (path / INDEX if path.is_dir() else path).stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns
