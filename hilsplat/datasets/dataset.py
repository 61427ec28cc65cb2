"""Descriptions of data sets (scenes, layout, licence, reader), available without reading their files."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hilsplat.base.errors import SceneError, shorten_list
from hilsplat.base.files import IMAGE_SUFFIXES

ABLATIONS = (
    *("ablation", "components", "cost", "cost-seconds", "pruning", "pruning-seconds"),
    *("efficiency", "efficiency-seconds", "theta", "omega"),
)
"""Tables of scenes whose labels have levels, besides those of benchmarks."""


@dataclass(frozen=True)
class SceneReport:
    """Counts of what was read in a scene, and a sentence for each item that was reinterpreted or not used."""

    facts: dict[str, object]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Dataset:
    """A benchmark in its published layout.

    Attributes:
        name: key in the registry, and name in table rows and paths.
        title: name as written in papers.
        labels: "images" for labelled pixels, "points" for labelled mesh vertices or lidar points.
        scenes: scenes in the paper's tables.
        terms: the user's obligations under the licence, in one sentence.
        layout: the expected file tree, as user-facing text.
        required: function that returns the paths a scene needs.
        open: function that reads a scene from the data set's folder into a `LabelledScene` or `PointScene`.
        protocols: keys in `evaluate.protocols.cards`, in addition to the protocols for all image labels.
        label_places: function that returns glob patterns for a scene's labels, which only evaluation reads.
        folder: the data set's folder below `data_root`, if it differs from the name.
        tables: names of the tables that show its scores (`evaluate.tables`).
        images_of: data set whose images it labels, if it has none of its own.
        origin: where to get it, as text that is printed to users.
    """

    name: str
    title: str
    labels: Literal["images", "points"]
    scenes: tuple[str, ...]
    licence: str
    terms: str
    citation: str
    layout: str
    required: Callable[[str], tuple[str, ...]]
    open: Callable[[Path, str], Any]
    protocols: tuple[str, ...] = ()
    label_places: Callable[[str], tuple[str, ...]] = lambda scene: ()
    folder: str = ""
    tables: tuple[str, ...] = ()
    images_of: str = ""
    origin: str = ""

    def root(self, data_root: Path | str) -> Path:
        """Return the data set's folder, to which all its paths are relative."""
        return Path(data_root).expanduser() / (self.folder or self.name)

    def check(self, root: Path, scene: str) -> SceneReport:
        """Read a whole scene and report what was found."""
        return self.open(root, scene).report()

    def needs(self, root: Path, scene: str) -> tuple[str, ...]:
        """Return the paths that a scene needs, relative to the data set's folder `root`."""
        return self.required(scene)

    def num_images(self, files: Sequence[Path]) -> int:
        """Return the number of images of a scene with point labels, from the files that it needs."""
        return sum(path.suffix.lower() in IMAGE_SUFFIXES for path in files)

    def missing(self, root: Path, scene: str) -> tuple[str, ...]:
        """Return the required paths of a scene that are missing below the data set's folder `root`."""
        # `normpath` resolves `..` even if the folder before it does not exist.
        paths = {name: Path(os.path.normpath(root / name)) for name in self.needs(root, scene)}
        return tuple(name for name, path in paths.items() if not path.exists())

    def found(self, root: Path) -> tuple[str, ...]:
        """Return the known scenes that have all required paths."""
        return tuple(scene for scene in self.scenes if not self.missing(root, scene))

    def locate(self, data_root: Path) -> Path:
        """Return the data set's folder; raise SceneError if it isn't directly below `data_root`."""
        root = self.root(data_root)
        data_root = root.parent
        if self._has_begun(root):
            return root
        fixes = dict.fromkeys(subfolders(root), f"move its contents to {root}")
        fixes[data_root] = f"rename it to {root.name} if necessary, and set data_root to its parent folder"
        fixes |= {deeper / root.name: f"set data_root to {deeper}" for deeper in subfolders(data_root)}
        for folder, fix in fixes.items():
            if self._has_begun(folder):
                raise SceneError(f"{self.title} is in the wrong place", expected=root, found=folder, fix=fix)
        raise SceneError(
            f"{data_root} does not contain {self.title}",
            expected=f"{root}, containing at least one of: {', '.join(self.scenes[:8])}",
            found=listing(root if root.is_dir() else data_root),
            fix="unpack it there; to print its layout, run: hilsplat datasets list",
        )

    def require(self, root: Path, scene: str) -> None:
        """Raise SceneError if a scene lacks a required path, for instance if it was only partly unpacked."""
        missing = self.missing(root, scene)
        if missing:
            here = [name for name in self.needs(root, scene) if name not in missing]
            raise SceneError(
                f"scene {scene} of {self.title} is incomplete in {root}",
                expected=f"also {', '.join(missing)}",
                found=", ".join(here) or listing(root),
                fix="unpack the whole archive again, or correct the scene name",
            )

    def has_part(self, root: Path, scene: str) -> bool:
        """Return whether a required path of a scene exists; paths outside `root` are ignored."""
        inside = [name for name in self.needs(root, scene) if not name.startswith("..")]
        return any((root / name).exists() for name in inside)

    def _has_begun(self, root: Path) -> bool:
        """Return whether a folder contains part of a known scene or, if no scenes are known, any scene."""
        return any(self.has_part(root, scene) for scene in self.scenes) or bool(self.found(root))


def subfolders(folder: Path) -> list[Path]:
    """Return the subfolders that archive programs did not add, sorted by name; empty if it is missing."""
    folders = folder.iterdir() if folder.is_dir() else ()
    return sorted(path for path in folders if path.is_dir() and not path.name.startswith((".", "__")))


def listing(folder: Path) -> str:
    """List the first eight files and folders in a folder, for messages."""
    if not folder.is_dir():
        return f"no folder {folder}"
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    return shorten_list(names, 8) or f"an empty folder {folder}"
