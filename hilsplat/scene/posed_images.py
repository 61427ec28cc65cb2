"""Images with known pose and lens, and the folder format from which `poses` imports them."""

import json
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from plyfile import PlyData, PlyElement

from hilsplat.base.artifacts import atomic_folder, write_text
from hilsplat.base.errors import SceneError
from hilsplat.base.rotations import RIGID_TOLERANCE, are_rotations

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
HALF_PIXEL = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
"""Offset added to a K with integer pixel centres; here, the centre of the first pixel is (0.5, 0.5)."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image and its camera.

    Attributes:
        name: file name in the imported folder.
        image: the file, or its encoded bytes if the data set stores images inside other files.
        cam_from_world: world-to-camera transform, OpenCV axes, in the unit of the scene.
        K: intrinsics, px; the centre of the first pixel is (0.5, 0.5).
        distortion: k1, k2, p1, p2, k3 as defined by OpenCV.
    """

    name: str
    image: Path | bytes
    cam_from_world: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    size_hw: tuple[int, int]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def world_from_cam(self) -> Float[np.ndarray, "4 4"]:
        """Camera-to-world transform, OpenCV axes."""
        return np.linalg.inv(self.cam_from_world)


def cam_from_world_of(world_from_cam: Float[np.ndarray, "4 4"], where: str) -> Float[np.ndarray, "4 4"]:
    """Invert a camera-to-world matrix, and refuse one that is not a rotation and translation."""
    rigid = are_rotations(world_from_cam[:3, :3], RIGID_TOLERANCE)
    if not rigid or not np.allclose(world_from_cam[3], [0, 0, 0, 1]):
        raise SceneError(
            f"{where}: the pose is not a rotation and translation",
            expected="a 4 x 4 camera-to-world matrix, row by row, last row 0 0 0 1",
            found=np.array2string(world_from_cam, precision=4, suppress_small=True).replace("\n", ""),
            fix="export the poses again",
        )
    return np.linalg.inv(world_from_cam)


def write_posed_images(
    folder: Path,
    images: Sequence[PosedImage],
    points: Float[np.ndarray, "P 3"] | None = None,
    colours: UInt8[np.ndarray, "P 3"] | None = None,
) -> None:
    """Write `images/` and `transforms.json` (OpenGL axes, intrinsics per frame) as a source for `poses`.

    Images are copied byte for byte; distortion is kept, because `poses` undistorts. Points, if any, are
    written to `points.ply` and become the scene's sparse points, in the same order.

    An existing folder is replaced. Points are in the unit of the poses.
    """
    names = [image.name for image in images]
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice or not images:
        raise SceneError(
            f"posed images cannot be written to {folder}",
            expected="at least one image, each with a unique name",
            found=f"{len(images)} images, twice: {', '.join(twice) or 'none'}",
        )
    with atomic_folder(folder) as temporary:
        (temporary / "images").mkdir()
        frames = []
        for image in images:
            target = temporary / "images" / image.name
            if isinstance(image.image, bytes):
                target.write_bytes(image.image)
            else:
                shutil.copyfile(image.image, target)
            frames.append(_frame(image))
        content: dict[str, object] = {"frames": frames}
        if points is not None:
            content["ply_file_path"] = "points.ply"
            columns = {axis: ("<f4", np.asarray(points)[:, k]) for k, axis in enumerate("xyz")}
            if colours is not None:
                columns |= {name: ("u1", colours[:, k]) for k, name in enumerate(("red", "green", "blue"))}
            table = np.empty(len(points), [(name, kind) for name, (kind, _) in columns.items()])
            for name, (_, values) in columns.items():
                table[name] = values
            PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(temporary / "points.ply")
        write_text(temporary / "transforms.json", json.dumps(content, indent=1) + "\n")


def _frame(image: PosedImage) -> dict[str, object]:
    height, width = image.size_hw
    frame: dict[str, object] = {
        "file_path": f"images/{image.name}",
        "transform_matrix": (image.world_from_cam @ OPENCV_TO_OPENGL).tolist(),
        "w": width,
        "h": height,
        "fl_x": float(image.K[0, 0]),
        "fl_y": float(image.K[1, 1]),
        "cx": float(image.K[0, 2]),
        "cy": float(image.K[1, 2]),
    }
    if any(image.distortion):
        frame.update(zip(("k1", "k2", "p1", "p2", "k3"), image.distortion, strict=True))
    return frame
