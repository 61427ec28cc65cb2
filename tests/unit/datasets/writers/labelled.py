"""A finished synthetic scene, and functions that write it in the layouts of the image-labelled data sets.

Readers must return its ground truth. Images are compressed (.jpg), as in the data sets; masks, boxes, texts
and poses are exact.
"""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from PIL import Image

from hilsplat.base.artifacts import write_json, write_text
from hilsplat.base.images import read_image, write_png
from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.datasets.images.isat import trace_polygons
from hilsplat.datasets.points.labelled_points import PlyMesh
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.scene.exporting import write_model
from hilsplat.scene.layouts import POSES_BOUNDS
from hilsplat.scene.posed_images import PosedImage

MAX_POINTS = 5000  # maximum number of sparse points in a COLMAP model, sampled evenly from the mesh


@dataclass(frozen=True, eq=False)
class TrueWorld:
    """Image folder, ground-truth cameras, annotations and visible surface points of a synthetic scene."""

    images: Path
    cameras: Cameras
    annotations: HierarchyAnnotations
    points_xyz: Float64[np.ndarray, "P 3"]

    @staticmethod
    def open(folder: Path) -> "TrueWorld":
        """Read a folder that the world stage wrote: `images/` and `truth/`."""
        truth, points = folder / "truth", np.zeros((0, 3))
        cameras, annotations = Cameras.load(truth / "cameras.npz"), HierarchyAnnotations.load(truth)
        if (truth / "mesh.ply").is_file():
            mesh = PlyMesh(truth / "mesh.ply", 3)
            points = mesh.xyz[mesh.column("vertex", "views") > 0].astype(np.float64)
            points = points[:: max(1, -(-len(points) // MAX_POINTS))]
        return TrueWorld(folder / "images", cameras, annotations, points)

    def nodes(self, view: str, level: Level | None = None) -> dict[str, tuple[int, ...]]:
        """Return the annotated and visible nodes of a view by text, sorted, for one level or all levels."""
        found: dict[str, list[int]] = {}
        for one in Level if level is None else (level,):
            labels = self.annotations.label_image(view, one)
            for text, ids in self.annotations.texts(view, one).items():
                seen = [node for node in ids if (labels == node).any()]
                if seen:
                    found.setdefault(text, []).extend(seen)
        return {text: tuple(found[text]) for text in sorted(found)}

    def mask(self, view: str, nodes: Iterable[int]) -> Bool[np.ndarray, "H W"]:
        """Return the union of nodes of any levels."""
        return np.any([self.annotations.mask(view, [node]) for node in nodes], axis=0)


def write_jpeg(path: Path, pixels: UInt8[np.ndarray, "H W 3"]) -> None:
    """Write an image at quality 95."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.ascontiguousarray(pixels)).save(path, quality=95)


def write_sparse(
    folder: Path, cameras: Sequence[Camera], names: Sequence[str], points_xyz: Float64[np.ndarray, "P 3"]
) -> None:
    """Write a COLMAP model (binary) of pinhole cameras and grey points without tracks."""
    folder.mkdir(parents=True, exist_ok=True)
    pairs = zip(names, cameras, strict=True)
    images = [PosedImage(name, folder, each.cam_from_world, each.K, each.size_hw) for name, each in pairs]
    write_model(folder, images, points_xyz, np.full(points_xyz.shape, 128, np.uint8))


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


LERF_STEMS, OVS_STEMS = ("frame_{:05d}", 1), ("{:02d}", 0)
"""Pattern of the stems, which are numbered in camera order, and the first number."""


def write_lerf_ovs(world: TrueWorld, root: Path, scene: str, views: Sequence[str]) -> None:
    """Write `root/<scene>` and `root/label/<scene>`: all texts in the given views, one object per polygon."""
    stems = _write_images(world, root / scene, LERF_STEMS)
    for view in views:
        objects = [
            isat_object(text, [polygon])
            for text, nodes in world.nodes(view).items()
            for node in nodes
            for polygon in trace_polygons(world.mask(view, [node]))
        ]
        _write_labels(world, root / "label" / scene, view, stems[view], objects)


def write_lerf_mask(
    world: TrueWorld, root: Path, scene: str, views: Sequence[str], level: Level = Level.WHOLE
) -> None:
    """Write `root/<scene>` with masks of one level's texts in the given test views."""
    stems, train = _write_images(world, root / scene, LERF_STEMS), root / scene / "images_train"
    train.mkdir()
    for view in world.cameras.names:
        if view not in views:
            shutil.copy(root / scene / "images" / f"{stems[view]}.jpg", train)
    for number, view in enumerate(sorted(views)):
        for text, nodes in world.nodes(view, level).items():
            place = root / scene / "test_mask" / str(number)
            _write_mask(place / f"{text}.png", world.mask(view, nodes))


def write_3d_ovs(world: TrueWorld, root: Path, scene: str, views: Sequence[str]) -> None:
    """Write `root/<scene>`: classes are the wholes in any segmented view; other views get empty masks."""
    folder = root / scene
    stems = _write_images(world, folder, OVS_STEMS)
    shown = {view: world.nodes(view, Level.WHOLE) for view in views}
    classes = sorted({text for texts in shown.values() for text in texts})
    for view, texts in shown.items():
        empty = np.zeros(world.cameras[view].size_hw, dtype=bool)
        for text in classes:
            mask = world.mask(view, texts[text]) if text in texts else empty
            _write_mask(folder / "segmentations" / stems[view] / f"{text}.png", mask)
    write_text(folder / "segmentations" / "classes.txt", "\n".join(classes) + "\n")
    # LLFF's file, the inverse of `known_views.read_llff`; the two depths are not read, so they are 0.
    world_from_cam = np.linalg.inv(world.cameras.cam_from_world)
    right, down, forward, centre = (world_from_cam[:, :3, column] for column in range(4))
    sizes = np.column_stack([world.cameras.size_hw, world.cameras.K[:, 0, 0]])
    matrices = np.stack([down, right, -forward, centre, sizes], axis=2).reshape(-1, 15)
    np.save(folder / POSES_BOUNDS, np.pad(matrices, ((0, 0), (0, 2))))


def write_hi(
    world: TrueWorld, root: Path, images_root: Path, scene: str, views: Sequence[str], stems: tuple[str, int]
) -> None:
    """Write `root/label/<scene>` in the format of `hi`, and images in `images_root` without other labels."""
    names = _write_images(world, images_root / scene, stems)
    nodes = world.annotations.nodes
    for view in views:
        shown = {node for level in LEVELS for ids in world.nodes(view, level).values() for node in ids}
        objects = []
        for node in sorted(shown):
            parent = nodes[node].parent
            keys = {"id": node, "parent": parent if parent in shown else None, "level": nodes[node].level}
            objects.append(isat_object(nodes[node].text, trace_polygons(world.mask(view, [node])), **keys))
        _write_labels(world, root / "label" / scene, view, names[view], objects)


def _write_images(world: TrueWorld, folder: Path, pattern: tuple[str, int]) -> Mapping[str, str]:
    """Write images and a COLMAP model; return the stems of the files by view."""
    form, first = pattern
    stems = {view: form.format(row) for row, view in enumerate(world.cameras.names, start=first)}
    for view, stem in stems.items():
        write_jpeg(folder / "images" / f"{stem}.jpg", read_image(world.images / view))
    cameras = [world.cameras[view] for view in stems]
    names = [f"{stem}.jpg" for stem in stems.values()]
    write_sparse(folder / "sparse" / "0", cameras, names, world.points_xyz)
    return stems


def _write_labels(world: TrueWorld, folder: Path, view: str, stem: str, objects: list[dict]) -> None:
    height, width = world.cameras[view].size_hw
    info = {"name": f"{stem}.jpg", "width": width, "height": height}
    write_json(folder / f"{stem}.json", {"info": info, "objects": objects})


def _write_mask(path: Path, mask: Bool[np.ndarray, "H W"]) -> None:
    write_png(path, mask.astype(np.uint8) * np.uint8(255))


def isat_object(category: str, polygons: list[np.ndarray], **keys: Any) -> dict[str, Any]:
    """Return keys of one object as the tool writes them: a single polygon is not nested."""
    points = np.concatenate(polygons)
    lists = [polygon.astype(float).tolist() for polygon in polygons]
    return {
        "category": category,
        "group": 1,
        "segmentation": lists[0] if len(lists) == 1 else lists,
        "bbox": [float(n) for n in (*points.min(axis=0), *points.max(axis=0))],
        **keys,
    }
