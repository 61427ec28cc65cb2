"""Writers: a synthetic scene in the layouts of the image-labelled data sets.

Image formats are those of the data sets (.jpg), so pixels are compressed; masks, boxes, texts and poses are
exact. Each writer returns the new stem of every view.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.artifacts import write_json, write_text
from hilsplat.base.errors import SceneError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.scene.importers.llff import POSES_BOUNDS
from tests.unit.datasets.writers.polygons import polygons_of
from tests.unit.datasets.writers.true_world import (
    TrueWorld,
    chosen_views,
    stems_from,
    write_image,
    write_mask,
    write_sparse,
)

LERF_STEMS = ("frame_{:05d}", 1)
OVS_STEMS = ("{:02d}", 0)


def write_lerf_ovs(world: TrueWorld, root: Path, scene: str, views: Sequence[str]) -> Mapping[str, str]:
    """Write `root/<scene>` and `root/label/<scene>`.

    Each connected piece of a node is a separate object, since the layout has one polygon per object.

    Args:
        world: the source.
        root: the folder `lerf_ovs`.
        scene: new name.
        views: views that are labelled, with all texts of all levels.
    """
    stems = _write_images(world, root / scene, LERF_STEMS)
    for view in chosen_views(world, views):
        objects = [
            isat_object(text, [polygon], int(world.mask(view, [node]).sum()))
            for text, nodes in world.nodes(view).items()
            for node in nodes
            for polygon in polygons_of(world.mask(view, [node]))
        ]
        _write_labels(world, root / "label" / scene, view, stems[view], objects)
    return stems


def write_lerf_mask(
    world: TrueWorld, root: Path, scene: str, views: Sequence[str], level: Level = Level.WHOLE
) -> Mapping[str, str]:
    """Write `root/<scene>` with test masks of the texts of one level.

    Args:
        world: the source.
        root: the folder `lerf_mask`.
        scene: new name.
        views: test views; the others are copied to `images_train`.
        level: whose texts are asked.

    Raises:
        SceneError: a text has a dot or a slash.
    """
    stems = _write_images(world, root / scene, LERF_STEMS)
    for view in world.cameras.names:
        if view not in views:
            write_image(root / scene / "images_train" / f"{stems[view]}.jpg", world.image(view))
    for number, view in enumerate(sorted(chosen_views(world, views), key=lambda view: stems[view])):
        for text, nodes in world.nodes(view, level).items():
            place = root / scene / "test_mask" / str(number)
            write_mask(place / f"{_file_name(text, dots=False)}.png", world.mask(view, nodes))
    return stems


def write_3d_ovs(
    world: TrueWorld, root: Path, scene: str, views: Sequence[str], sparse: bool = True
) -> Mapping[str, str]:
    """Write `root/<scene>`: classes are the wholes that any of the views shows.

    Args:
        world: the source.
        root: the folder `3d_ovs`.
        scene: new name.
        views: segmented views; a class that a view does not show has an empty mask there.
        sparse: write a COLMAP model beside `poses_bounds.npy`.

    Raises:
        SceneError: a text has a slash.
    """
    folder = root / scene
    stems = _write_images(world, folder, OVS_STEMS, sparse)
    shown = {view: world.nodes(view, Level.WHOLE) for view in chosen_views(world, views)}
    classes = sorted({text for texts in shown.values() for text in texts})
    for view, texts in shown.items():
        empty = np.zeros(world.cameras[view].size_hw, dtype=bool)
        for text in classes:
            mask = world.mask(view, texts[text]) if text in texts else empty
            write_mask(folder / "segmentations" / stems[view] / f"{_file_name(text)}.png", mask)
    write_text(folder / "segmentations" / "classes.txt", "\n".join(classes) + "\n")
    cameras = world.cameras
    sizes = np.column_stack([cameras.size_hw, cameras.K[:, 0, 0]]).astype(np.float64)
    depths = np.stack([_depth_range(world, pose) for pose in cameras.cam_from_world])
    write_poses_bounds(folder / POSES_BOUNDS, cameras.cam_from_world, sizes, depths)
    return stems


def write_hi(
    world: TrueWorld, root: Path, images_root: Path, scene: str, views: Sequence[str], stems: tuple[str, int]
) -> Mapping[str, str]:
    """Write `root/label/<scene>` in the format of `hi`, and the images' data set without its labels.

    Args:
        world: the source.
        root: the folder `hi_lerf` or `hi_3dovs`.
        images_root: the folder `lerf_ovs` or `3d_ovs` beside it.
        scene: new name.
        views: labelled views.
        stems: pattern and first number of image names, `LERF_STEMS` or `OVS_STEMS`.
    """
    names = _write_images(world, images_root / scene, stems)
    nodes = world.annotations.nodes
    for view in chosen_views(world, views):
        shown = {node for level in LEVELS for ids in world.nodes(view, level).values() for node in ids}
        objects = []
        for node in sorted(shown):
            mask = world.mask(view, [node])
            parent = nodes[node].parent
            keys = {"id": node, "parent": parent if parent in shown else None, "level": nodes[node].level}
            objects.append(isat_object(nodes[node].text, polygons_of(mask), int(mask.sum()), **keys))
        _write_labels(world, root / "label" / scene, view, names[view], objects)
    return names


def _write_images(
    world: TrueWorld, folder: Path, pattern: tuple[str, int], sparse: bool = True
) -> Mapping[str, str]:
    stems = stems_from(world, *pattern)
    for view, stem in stems.items():
        write_image(folder / "images" / f"{stem}.jpg", world.image(view))
    if sparse:
        cameras = [world.cameras[view] for view in stems]
        names = [f"{stem}.jpg" for stem in stems.values()]
        write_sparse(folder / "sparse" / "0", cameras, names, world.points_xyz)
    return stems


def _write_labels(world: TrueWorld, folder: Path, view: str, stem: str, objects: list[dict]) -> None:
    write_isat(folder / f"{stem}.json", f"{stem}.jpg", world.cameras[view].size_hw, objects)


def _file_name(text: str, dots: bool = True) -> str:
    if "/" in text or (not dots and "." in text):
        raise SceneError(
            f"text {text!r} cannot be the name of a mask file",
            expected="no slash" if dots else "no slash and no dot",
            fix="choose another text",
        )
    return text


def _depth_range(world: TrueWorld, cam_from_world: np.ndarray) -> np.ndarray:
    """Nearest and farthest depth of the points in front of a camera; 0 and 1 if there are none."""
    depth = world.points_xyz @ cam_from_world[2, :3] + cam_from_world[2, 3]
    depth = depth[depth > 0]
    return np.array([depth.min(), depth.max()]) if len(depth) else np.array([0.0, 1.0])


def write_isat(path: Path, image: str, size_hw: tuple[int, int], objects: list[dict[str, Any]]) -> None:
    """Write a label file in the same layout.

    Args:
        path: the file.
        image: name of its image.
        size_hw: size of the image, px.
        objects: keys of each object; `category` and `segmentation` at least.
    """
    info = {"name": image, "width": size_hw[1], "height": size_hw[0], "depth": 3, "note": ""}
    write_json(path, {"info": info, "objects": objects})


def isat_object(category: str, polygons: list[np.ndarray], area_px: int, **keys: Any) -> dict[str, Any]:
    """Keys of one object as the tool writes them: a single polygon is not nested."""
    points = np.concatenate(polygons)
    lists = [
        # A single pixel or a line repeats its last vertex: a polygon has three.
        [[float(x), float(y)] for x, y in [*polygon, *[polygon[-1]] * (3 - len(polygon))]]
        for polygon in polygons
    ]
    return {
        "category": category,
        "group": 1,
        "segmentation": lists[0] if len(lists) == 1 else lists,
        "area": float(area_px),
        "layer": 1.0,
        "bbox": [float(n) for n in (*points.min(axis=0), *points.max(axis=0))],
        "iscrowd": 0,
        "note": "",
        **keys,
    }


def write_poses_bounds(
    path: Path,
    cam_from_world: Float64[np.ndarray, "N 4 4"],
    height_width_focal: Float64[np.ndarray, "N 3"],
    bounds: Float64[np.ndarray, "N 2"],
) -> None:
    """Write the file, the inverse of `read_poses_bounds`."""
    world_from_cam = np.linalg.inv(cam_from_world)
    right, down, forward = (world_from_cam[:, :3, column] for column in range(3))
    matrices = np.stack([down, right, -forward, world_from_cam[:, :3, 3], height_width_focal], axis=2)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.concatenate([matrices.reshape(-1, 15), bounds], axis=1), allow_pickle=False)
