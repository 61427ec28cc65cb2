"""What the annotation page was opened with: photographs, and what can be proposed in them."""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hilsplat.annotate.clicks import Clicks
from hilsplat.annotate.proposals import Proposals
from hilsplat.base.errors import ArtifactError
from hilsplat.scene.scene import Scene
from hilsplat.viewer.witness import Witness


class OpenedScene:
    """A scene as far as its run had come when it was opened.

    Args:
        folder: of the scene, such as results/photos/desk.
        variant: whose masks and tree are proposed.
        threads: number of threads for drawing.

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
        self.state, self._witness = secrets.token_hex(4), Witness()
        proposing = (folder / variant / "masks", folder / variant / "semantic_tree")
        self._witness.note((self.photographs, folder / "gaussians.ply", *proposing))
        self.scene = Scene.load(self.photographs)
        self.proposals = Proposals(self.scene, folder, variant, threads)
        self.clicks = Clicks(self.scene, folder / variant / "masks")

    def changed(self) -> list[str]:
        """Parts that were written anew, or exist by now, or no longer."""
        return sorted(path.name for path in self._witness.changed())

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Around proposals: they come from parts that belong together.

        Raises:
            StaleSceneError: a part was written anew before or meanwhile.
        """
        with self._witness.unchanged(self.scene.name):
            yield

    @contextmanager
    def same_photographs(self) -> Iterator[None]:
        """Around photographs and what is drawn on them, which another tree does not concern.

        Raises:
            StaleSceneError: the photographs were written anew before or meanwhile.
        """
        with self._witness.unchanged(self.scene.name, self.photographs):
            yield
