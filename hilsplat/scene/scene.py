"""A posed scene: cameras, undistorted images, sparse points, split."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from hilsplat.base.artifacts import read_index, read_npz, sealed, write_index, write_npz
from hilsplat.base.errors import SettingsError
from hilsplat.base.images import read_image
from hilsplat.scene.cameras import Cameras


@dataclass(frozen=True, eq=False)
class Scene:
    """A posed scene: the output `scene/` of the `poses` stage, which all later stages read.

    Attributes:
        folder: the scene artifact; images are `folder/images/<view name>`.
        name: `<dataset>/<scene>`.
        unit: unit of length, "metre" or "arbitrary".
        split: "train" or "test" for each view name. No stage between poses and evaluate uses test views.
        scene_from_source: similarity that maps source coordinates to the scene's.
    """

    folder: Path
    name: str
    unit: str
    cameras: Cameras
    split: dict[str, str]
    points_xyz: Float32[np.ndarray, "P 3"]
    points_rgb: UInt8[np.ndarray, "P 3"]
    scene_from_source: Float[np.ndarray, "4 4"]

    def __repr__(self) -> str:
        views = f"{len(self.names)} views ({len(self.views('test'))} held out)"
        return f"Scene({self.name}: {views}, {len(self.points_xyz)} points)"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all views, in camera order."""
        return self.cameras.names

    def views(self, split: str | None = None) -> list[str]:
        """Return the view names of a split ("train", "test") or all view names, in camera order.

        Raises:
            SettingsError: the split is unknown.
        """
        if split not in (None, "train", "test"):
            raise SettingsError(f"split {split!r} is unknown", expected="train or test")
        return [name for name in self.cameras.names if split is None or self.split[name] == split]

    def image_path(self, view: str) -> Path:
        """Return the file of a view's undistorted image."""
        return self.folder / "images" / view

    def image(self, view: str) -> UInt8[np.ndarray, "H W 3"]:
        """Read a view's undistorted image."""
        return read_image(sealed(self.folder, f"images/{view}"))

    def save(self) -> None:
        """Write cameras, points and finally the index to `folder`, which must already contain the images."""
        self.cameras.save(self.folder / "cameras.npz")
        write_npz(
            self.folder / "points.npz",
            xyz=self.points_xyz.astype(np.float32),
            rgb=self.points_rgb.astype(np.uint8),
            scene_from_source=self.scene_from_source.astype(np.float64),
        )
        write_index(
            self.folder,
            {name: {"split": self.split[name]} for name in self.cameras.names},
            name=self.name,
            unit=self.unit,
        )

    @staticmethod
    def load(folder: Path) -> "Scene":
        """Read a scene folder written by the poses stage."""
        index = read_index(folder, "name", "unit")
        points = read_npz(sealed(folder, "points.npz"), "xyz", "rgb", "scene_from_source")
        return Scene(
            folder=Path(folder).absolute(),  # images are read later, perhaps in another working folder
            name=index["name"],
            unit=index["unit"],
            cameras=Cameras.load(sealed(folder, "cameras.npz")),
            split={name: entry["split"] for name, entry in index["views"].items()},
            points_xyz=points["xyz"],
            points_rgb=points["rgb"],
            scene_from_source=points["scene_from_source"],
        )
