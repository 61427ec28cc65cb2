"""Reader of LLFF's `poses_bounds.npy`, which 3D-OVS and other forward-facing data sets provide."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from hilsplat.base.artifacts import read_npy
from hilsplat.base.errors import ArtifactError, SceneError
from hilsplat.base.files import list_images
from hilsplat.base.images import open_image
from hilsplat.base.rotations import RIGID_TOLERANCE, are_rotations
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.importers.known_poses import KnownPoses, KnownView


def read_poses_bounds(
    path: Path,
) -> tuple[Float64[np.ndarray, "N 4 4"], Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 2"]]:
    """Read the poses, sizes and depths in `poses_bounds.npy`: N rows of 17 numbers.

    The first 15 are a 3 x 5 matrix, row by row: rotation columns (down, right, back), translation, and the
    column (height, width, focal). OpenCV's axes are x = right, y = down, z = -back. The last two are the
    near and the far depth.

    Returns:
        World-to-camera transforms (OpenCV axes), rows (height, width, focal) in px, rows (near, far).
    """
    try:
        rows = read_npy(path)
    except ArtifactError as error:
        raise SceneError(str(error).splitlines()[0], fix="unpack it again") from error
    if rows.ndim != 2 or rows.shape[1] != 17 or not np.isfinite(rows).all():
        raise SceneError(
            f"{path} does not hold LLFF poses",
            expected="finite numbers of shape (images, 17)",
            found=f"shape {rows.shape}",
            fix="unpack it again",
        )
    rows = rows.astype(np.float64)
    matrices = rows[:, :15].reshape(-1, 3, 5)
    world_from_cam = np.tile(np.eye(4), (len(rows), 1, 1))
    down, right, back = (matrices[:, :, column] for column in range(3))
    world_from_cam[:, :3, :3] = np.stack([right, down, -back], axis=2)
    world_from_cam[:, :3, 3] = matrices[:, :, 3]
    proper = are_rotations(world_from_cam[:, :3, :3], RIGID_TOLERANCE) & (matrices[:, :, 4] > 0).all(axis=1)
    if not proper.all():
        raise SceneError(
            f"{path}, row {int(np.argmin(proper))}: not a rigid pose with size and focal length",
            expected="rotation columns down, right, back, then translation, then height, width, focal",
            fix="write it again with LLFF's axes",
        )
    return np.linalg.inv(world_from_cam), matrices[:, :, 4], rows[:, 15:]


def read_llff(known: KnownPoses) -> list[KnownView]:
    """Read the posed views of an LLFF scene; row i is that of the i-th image by name.

    The lens is SIMPLE_PINHOLE with its centre in the middle, for the image size on disk.
    """
    path, folder = known.files[0], known.root / "images"
    poses, sizes, _ = read_poses_bounds(path)
    images = sorted(list_images(folder if folder.is_dir() else known.root), key=lambda image: image.stem)
    if len(images) != len(poses):
        raise SceneError(
            f"{path} has {len(poses)} poses for {len(images)} images",
            expected="one row per image, in the order of their names",
            found=f"{images[0].name} to {images[-1].name}" if images else "no images",
            fix="unpack the images again, and remove files that are not photographs of the scene",
        )
    views = []
    for image, pose, (_, width_px, focal_px) in zip(images, poses, sizes, strict=True):
        with open_image(image) as opened:
            width, height = opened.size
        params = [float(focal_px * width / width_px), width / 2, height / 2]
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)
        views.append(KnownView(image.name, image, camera, pose))
    return views
