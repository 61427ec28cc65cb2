"""Whether what was opened is still what lies on the disk."""

from collections.abc import Iterable
from pathlib import Path

from hilsplat.base.artifacts import INDEX
from hilsplat.base.errors import ArtifactError

State = tuple[int, int, int] | None


class StaleSceneError(ArtifactError):
    """A part of the scene was written anew since it was opened."""


class Witness:
    """Artifacts as they were before they were opened.

    Every writer replaces its output whole, so a file that was written anew is another one: `stat` tells,
    without reading it. Of a folder its index tells, which is written last.
    """

    def __init__(self) -> None:
        self._seen: dict[Path, State] = {}

    def note(self, paths: Iterable[Path]) -> None:
        """Remember artifacts as they are now, except for those that were noted before."""
        for path in paths:
            self._seen.setdefault(Path(path), _state(Path(path)))

    def changed(self) -> list[Path]:
        """Those that are no longer what they were, or gone."""
        return [path for path, seen in self._seen.items() if _state(path) != seen]


def _state(path: Path) -> State:
    try:
        found = (path / INDEX if path.is_dir() else path).stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns
