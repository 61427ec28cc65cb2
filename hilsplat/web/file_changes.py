"""Detection of artifacts that changed on disk since they were opened."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hilsplat.base.artifacts import INDEX
from hilsplat.base.errors import ArtifactError

State = tuple[int, int, int] | None


class StaleSceneError(ArtifactError):
    """A part of the scene was rewritten since it was opened."""


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
        """Guard disk reads: fail if files changed since the scene was opened.

        Args:
            scene: name of the scene, for the error.
            parts: artifacts that must be unchanged; by default, all recorded ones.

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
