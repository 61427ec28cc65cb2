"""The parts of a scene that the annotation page opened: photographs and sources of proposals."""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hilsplat.annotate.clicks import Clicks
from hilsplat.annotate.proposals import Proposals
from hilsplat.base.errors import ArtifactError
from hilsplat.scene.scene import Scene
from hilsplat.viewer.file_changes import FileChanges


class OpenedScene:
    """The parts of a scene that existed when it was opened.

    Args:
        folder: the scene's folder, such as results/photos/desk.
        variant: variant whose masks and tree are proposed.
        threads: number of threads for rendering.

    Raises:
        ArtifactError: the scene has no photographs with poses yet.
    """

    def __init__(self, folder: Path, variant: str, threads: int) -> None:
        self.photographs = Path(folder) / "scene"
        if not (self.photographs / "index.json").is_file():
            raise ArtifactError(
                f"{folder} has no photographs to annotate yet: {self.photographs} is missing",
                expected="results/<dataset>/<scene> of a run, or a copy of it",
                fix=f"hilsplat run {self.photographs}",
            )
        self.state, self._changes = secrets.token_hex(4), FileChanges()
        proposing = (folder / variant / "masks", folder / variant / "semantic_tree")
        self._changes.note((self.photographs, folder / "gaussians.ply", *proposing))
        self.scene = Scene.load(self.photographs)
        self.proposals = Proposals(self.scene, folder, variant, threads)
        self.clicks = Clicks(self.scene, folder / variant / "masks")

    def changed(self) -> list[str]:
        """Return the parts that were rewritten, created or deleted since the scene was opened."""
        return sorted(path.name for path in self._changes.changed())

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Guard proposals: fail if any part changed since the scene was opened.

        Raises:
            StaleSceneError: a part was rewritten before or during the read.
        """
        with self._changes.unchanged(self.scene.name):
            yield

    @contextmanager
    def same_photographs(self) -> Iterator[None]:
        """Guard photographs and drawing: fail if the photographs changed; other parts may change.

        Raises:
            StaleSceneError: the photographs were rewritten before or during the read.
        """
        with self._changes.unchanged(self.scene.name, self.photographs):
            yield
