"""Export of a scene for other programs (COLMAP, nerfstudio), in the coordinates of the scene's source."""

import errno
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from hilsplat.base.atomic import atomic_folder
from hilsplat.scene.assemble import move_cameras
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.posed_images import PosedImage, write_posed_images
from hilsplat.scene.scene import Scene

POINT_BYTES = 51
"""Size of a point without a track in COLMAP's points3D.bin, which begins with the number of points."""


def in_source(scene: Scene) -> tuple[list[PosedImage], Float64[np.ndarray, "P 3"]]:
    """Return undistorted images with their poses, and sparse points, in the coordinates of the source."""
    source_from_scene = np.linalg.inv(scene.scene_from_source)
    images = posed_images(scene, move_cameras(scene.cameras.cam_from_world, source_from_scene))
    points = scene.points_xyz.astype(np.float64) @ source_from_scene[:3, :3].T + source_from_scene[:3, 3]
    return images, points


def posed_images(scene: Scene, cam_from_world: Float64[np.ndarray, "V 4 4"]) -> list[PosedImage]:
    """Return the undistorted images of all views, with the given poses and the scene's split."""
    images = []
    for name, pose in zip(scene.cameras.names, cam_from_world, strict=True):
        camera, split = scene.cameras[name], scene.split[name]
        images.append(PosedImage(name, scene.image_path(name), pose, camera.K, camera.size_hw, split=split))
    return images


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
    pinhole_model(*in_source(scene), scene.points_rgb).write_binary(model)
    points = model / "points3D.bin"  # is written last; COLMAP ignores a full disk
    if points.stat().st_size != 8 + POINT_BYTES * len(scene.points_rgb):
        raise ChildProcessError(errno.EIO, "COLMAP wrote an incomplete file", str(points))


def pinhole_model(
    images: Sequence[PosedImage], xyz: Float64[np.ndarray, "P 3"], rgb: UInt8[np.ndarray, "P 3"]
) -> pycolmap.Reconstruction:
    """Return a COLMAP model of pinhole cameras and points without tracks."""
    model = pycolmap.Reconstruction()
    for number, posed in enumerate(images, start=1):
        (height, width), K = posed.size_hw, posed.K
        lens = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="PINHOLE", width=width, height=height, params=lens, camera_id=number)
        )
        image = pycolmap.Image(name=posed.name, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(posed.cam_from_world[:3]))
    for position, colour in zip(xyz, rgb, strict=True):
        model.add_point3D(position, pycolmap.Track(), colour)
    return model


def write_nerfstudio(scene: Scene, out: Path) -> None:
    """Write `images/`, `transforms.json` and the sparse points in `points.ply`."""
    write_posed_images(out, *in_source(scene), scene.points_rgb)
