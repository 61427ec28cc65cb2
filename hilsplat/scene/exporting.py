"""Export of a scene for other programs (COLMAP, nerfstudio), in the coordinates of the scene's source."""

import os
import shutil
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from hilsplat.base.atomic import atomic_folder
from hilsplat.base.rotations import quaternion_of
from hilsplat.scene.assemble import move_cameras
from hilsplat.scene.posed_images import PosedImage, write_posed_images
from hilsplat.scene.scene import Scene

PINHOLE = 1  # number of COLMAP's camera model fx, fy, cx, cy
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error_px", "<f8"), ("track", "<u8")])
"""A point without a track, as in COLMAP's points3D.bin."""


def in_source(scene: Scene) -> tuple[list[PosedImage], Float64[np.ndarray, "P 3"]]:
    """Return undistorted images with their poses, and sparse points, in the coordinates of the source."""
    source_from_scene = np.linalg.inv(scene.scene_from_source)
    images = posed_images(scene, move_cameras(scene.cameras.cam_from_world, source_from_scene))
    points = scene.points_xyz.astype(np.float64) @ source_from_scene[:3, :3].T + source_from_scene[:3, 3]
    return images, points


def posed_images(scene: Scene, cam_from_world: Float64[np.ndarray, "V 4 4"]) -> list[PosedImage]:
    """Return the undistorted images of all views, with the given poses and the scene's split."""
    return [
        PosedImage(c.name, scene.image_path(c.name), pose, c.K, c.size_hw, split=scene.split[c.name])
        for c, pose in zip(scene.cameras, cam_from_world, strict=True)
    ]


def write_colmap(scene: Scene, out: Path) -> None:
    """Write `images/` and a COLMAP model in `sparse/0` to a new folder, atomically."""
    with atomic_folder(out) as folder:
        add_colmap(scene, folder)


def add_colmap(scene: Scene, folder: Path) -> None:
    """Write `images/` and a COLMAP model in `sparse/0` (binary; points without tracks) to a folder."""
    (folder / "images").mkdir()
    for view in scene.views():
        shutil.copyfile(scene.image_path(view), folder / "images" / view)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    write_model(model, *in_source(scene), scene.points_rgb)


def write_model(
    folder: Path, images: Sequence[PosedImage], xyz: Float64[np.ndarray, "P 3"], rgb: UInt8[np.ndarray, "P 3"]
) -> None:
    """Write a binary COLMAP model of pinhole cameras and points without tracks (pycolmap hides write errors).

    Without `rigs.bin` and `frames.bin`, COLMAP gives each image a rig of its own.
    """
    count = struct.pack("<Q", len(images))
    cameras, poses = [count], [count]
    for number, image in enumerate(images, start=1):
        (height, width), K, pose = image.size_hw, image.K, image.cam_from_world
        lens = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        cameras.append(struct.pack("<IiQQ4d", number, PINHOLE, width, height, *lens))
        numbers = *quaternion_of(pose[:3, :3]), *pose[:3, 3]
        name_and_observations = os.fsencode(image.name) + bytes(1 + 8)
        poses.append(struct.pack("<I7dI", number, *numbers, number) + name_and_observations)
    points = np.zeros(len(xyz), POINT)
    points["id"], points["xyz"], points["rgb"], points["error_px"] = 1 + np.arange(len(xyz)), xyz, rgb, -1
    (folder / "cameras.bin").write_bytes(b"".join(cameras))
    (folder / "images.bin").write_bytes(b"".join(poses))
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(xyz)) + points.tobytes())


def write_nerfstudio(scene: Scene, out: Path) -> None:
    """Write `images/`, `transforms.json` and the sparse points in `points.ply`."""
    write_posed_images(out, *in_source(scene), scene.points_rgb)
