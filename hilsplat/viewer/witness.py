"""Whether what was opened is still what lies on the disk."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
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

    @contextmanager
    def unchanged(self, scene: str, *parts: Path) -> Iterator[None]:
        """Around whatever reads the disk: it must read what belongs to what was opened before.

        Args:
            scene: its name, for the error.
            parts: those that must be unchanged; without any, all that were noted.

        Raises:
            StaleSceneError: a part was written anew before or meanwhile.
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
