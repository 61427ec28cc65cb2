"""The parts of a scene that the annotation page opened: photographs and sources of proposals."""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from hilsplat.annotate.labels import Label, label_path, read_labels
from hilsplat.annotate.proposals import Clicks, Proposals
from hilsplat.base.errors import ArtifactError
from hilsplat.scene.scene import Scene
from hilsplat.web.scene_thread import ShownScene


class OpenedScene(ShownScene):
    """The parts of a scene that existed when it was opened.

    Args:
        folder: the scene's folder, such as results/photos/desk.
        labels: folder of its label files; created when the first one is written.
        variant: variant whose masks and tree are proposed.

    Raises:
        ArtifactError: the scene has no photographs with poses yet.
    """

    def __init__(self, folder: Path, labels: Path, variant: str, threads: int) -> None:
        super().__init__()
        self.folder, self.labels, self.variant, self.threads = folder, labels, variant, threads
        self.photographs = folder / "scene"
        if not (self.photographs / "index.json").is_file():
            raise ArtifactError(
                f"{folder} has no photographs to annotate yet: {self.photographs} is missing",
                expected="results/<dataset>/<scene> of a run, or a copy of it",
                fix=f"hilsplat run {self.photographs}",
            )
        proposing = (folder / variant / "masks", folder / variant / "semantic_tree")
        self.changes.note((self.photographs, folder / "gaussians.ply", *proposing))
        self.scene = Scene.load(self.photographs)
        self.proposals = Proposals(self.scene, folder, variant, threads)
        self.clicks = Clicks(self.scene, folder / variant / "masks")

    def opened_again(self) -> "OpenedScene":
        return OpenedScene(self.folder, self.labels, self.variant, self.threads)

    def same_photographs(self) -> AbstractContextManager[None]:
        """Guard photographs and drawing: as `unchanged`, but parts other than photographs may change."""
        return self.changes.unchanged(self.scene.name, self.photographs)

    def described(self) -> dict[str, Any]:
        """Describe the photographs and available proposals."""
        cameras = self.scene.cameras
        return {
            "name": self.scene.name,
            "of": self.state,
            "folder": str(self.labels),
            "proposes": self.proposals.of,
            "segments": self.clicks.name,
            "carries": self.proposals.gaussians is not None,
            "views": [
                {"name": name, "split": self.scene.split[name], "size_hw": list(cameras[name].size_hw)}
                for name in cameras.names
            ],
        }

    def known(self) -> dict[str, list[Label]]:
        """Return the annotations of all views that have any."""
        cameras = self.scene.cameras
        found = {
            view: read_labels(label_path(self.labels, view), cameras[view].size_hw) for view in cameras.names
        }
        return {view: labels for view, labels in found.items() if labels}
