"""A finished synthetic scene as source for writers of data set layouts: readers must return its truth."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from PIL import Image

from hilsplat.base.images import read_image
from hilsplat.base.levels import Level
from hilsplat.datasets.points.point_files import ply_column, ply_places, read_ply
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.scene.exporting import pinhole_model
from hilsplat.scene.posed_images import PosedImage

MAX_POINTS = 5000
"""Maximum number of sparse points in a COLMAP model, sampled evenly from the mesh."""


@dataclass(frozen=True, eq=False)
class TrueWorld:
    """Images (a folder), true cameras, annotations and visible surface points of a synthetic scene."""

    images: Path
    cameras: Cameras
    annotations: HierarchyAnnotations
    points_xyz: Float64[np.ndarray, "P 3"]

    @staticmethod
    def open(folder: Path) -> "TrueWorld":
        """Read a folder that the world stage wrote: `images/` and `truth/`."""
        truth = folder / "truth"
        cameras, annotations = Cameras.load(truth / "cameras.npz"), HierarchyAnnotations.load(truth)
        mesh = truth / "mesh.ply"
        points = _mesh_points(mesh) if mesh.is_file() else np.zeros((0, 3))
        return TrueWorld(folder / "images", cameras, annotations, points)

    def image(self, view: str) -> UInt8[np.ndarray, "H W 3"]:
        """Pixels of a view."""
        return read_image(self.images / view)

    def nodes(self, view: str, level: Level | None = None) -> dict[str, tuple[int, ...]]:
        """Annotated and visible nodes of a view by text, of one level or of all; texts sorted."""
        found: dict[str, list[int]] = {}
        for one in Level if level is None else (level,):
            labels = self.annotations.label_image(view, one)
            for text, ids in self.annotations.texts(view, one).items():
                seen = [node for node in ids if (labels == node).any()]
                if seen:
                    found.setdefault(text, []).extend(seen)
        return {text: tuple(found[text]) for text in sorted(found)}

    def mask(self, view: str, nodes: Iterable[int]) -> Bool[np.ndarray, "H W"]:
        """Union of nodes of any levels."""
        return np.any([self.annotations.mask(view, [node]) for node in nodes], axis=0)


def _mesh_points(path: Path) -> Float64[np.ndarray, "P 3"]:
    mesh = read_ply(path, 3)
    xyz = ply_places(path, mesh)[ply_column(path, mesh, "vertex", "views") > 0].astype(np.float64)
    return xyz[:: max(1, -(-len(xyz) // MAX_POINTS))]


def write_jpeg(path: Path, pixels: UInt8[np.ndarray, "H W 3"]) -> None:
    """Write an image at quality 95, as photographs come."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.ascontiguousarray(pixels)).save(path, quality=95)


def write_sparse(
    folder: Path, cameras: Sequence[Camera], names: Sequence[str], points_xyz: Float64[np.ndarray, "P 3"]
) -> None:
    """Write a COLMAP model (binary) of pinhole cameras and grey points without tracks."""
    folder.mkdir(parents=True, exist_ok=True)
    pairs = zip(names, cameras, strict=True)
    images = [PosedImage(name, folder, each.cam_from_world, each.K, each.size_hw) for name, each in pairs]
    pinhole_model(images, points_xyz, np.full(points_xyz.shape, 128, np.uint8)).write(folder)


def stems_from(world: TrueWorld, pattern: str, first: int) -> Mapping[str, str]:
    """New stem per view, numbered in camera order: ("frame_{:05d}", 1) gives frame_00001, ..."""
    return {view: pattern.format(row) for row, view in enumerate(world.cameras.names, start=first)}


def flat_images(
    folder: Path,
    poses: Sequence[Float64[np.ndarray, "4 4"]],
    K: Float64[np.ndarray, "3 3"],
    size_hw: tuple[int, int],
) -> list[PosedImage]:
    """Write one grey image per camera-to-world pose, with its number as value."""
    images = []
    for number, pose in enumerate(poses):
        path = folder / f"{number}.jpg"
        write_jpeg(path, np.full((*size_hw, 3), number, np.uint8))
        images.append(PosedImage(path.name, path, np.linalg.inv(pose), K, size_hw))
    return images
