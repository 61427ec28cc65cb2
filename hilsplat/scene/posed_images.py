"""Images with known poses and lenses, and the folder format from which `poses` imports them."""

import json
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8
from plyfile import PlyData, PlyElement

from hilsplat.base.artifacts import write_text
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import SceneError
from hilsplat.base.rotations import RIGID_TOLERANCE, are_rotations

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # conversion of camera axes, which is its own inverse

HALF_PIXEL = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
"""Offset added to a K with integer pixel centres; in this project, the first pixel's centre is (0.5, 0.5)."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image and its camera.

    Attributes:
        name: file name in the imported folder.
        image: the file, or its encoded bytes if the data set stores images inside other files.
        cam_from_world: world-to-camera transform, OpenCV axes, in the unit of the scene.
        K: intrinsics, px; the centre of the first pixel is (0.5, 0.5).
        distortion: k1, k2, p1, p2, k3 as defined by OpenCV.
        split: "train" or "test"; empty if `poses` decides.
    """

    name: str
    image: Path | bytes
    cam_from_world: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    size_hw: tuple[int, int]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    split: str = ""

    @property
    def world_from_cam(self) -> Float[np.ndarray, "4 4"]:
        """Camera-to-world transform, OpenCV axes."""
        return np.linalg.inv(self.cam_from_world)


def rigid_pose(world_from_cam: Float[np.ndarray, "..."], where: str) -> Float64[np.ndarray, "4 4"]:
    """Return a 3 x 4 or 4 x 4 camera-to-world matrix as 4 x 4; raise SceneError if it is not rigid."""
    pose = np.eye(4)
    usable = world_from_cam.shape in ((3, 4), (4, 4)) and np.isfinite(world_from_cam).all()
    if usable:
        pose[: len(world_from_cam)] = world_from_cam
        usable = are_rotations(pose[:3, :3], RIGID_TOLERANCE) and np.allclose(pose[3], [0, 0, 0, 1])
    if not usable:
        raise SceneError(
            f"{where}: the pose is not a rotation and translation",
            expected="a 4 x 4 camera-to-world matrix with last row 0 0 0 1 and no scaling or mirroring",
            found=np.array2string(world_from_cam, precision=4, suppress_small=True).replace("\n", ""),
            fix="export the poses again, without scaling the cameras",
        )
    return pose


def write_posed_images(
    folder: Path,
    images: Sequence[PosedImage],
    points: Float[np.ndarray, "P 3"] | None = None,
    colours: UInt8[np.ndarray, "P 3"] | None = None,
) -> None:
    """Write `images/` and `transforms.json` (OpenGL axes, intrinsics per frame) as a source for `poses`.

    The split, if given, is listed as nerfstudio expects it; its validation views are the test views.

    Images are copied byte for byte; distortion is kept, because `poses` undistorts them. Points, if given,
    must be in the unit of the poses; `points.ply` stores them, and they become the scene's sparse points in
    the same order. An existing folder is replaced. SceneError is raised if two images have one name.
    """
    counts = Counter(image.name for image in images)
    if repeated := sorted(name for name, count in counts.items() if count > 1):
        raise SceneError(f"several posed images have the same name: {', '.join(repeated)}")
    with atomic_folder(folder) as temporary:
        (temporary / "images").mkdir()
        frames = []
        for image in images:
            target = temporary / "images" / image.name
            if isinstance(image.image, bytes):
                target.write_bytes(image.image)
            else:
                shutil.copyfile(image.image, target)
            height, width = image.size_hw
            frame: dict[str, object] = {
                "file_path": f"images/{image.name}",
                "transform_matrix": (image.world_from_cam @ OPENGL_TO_OPENCV).tolist(),
                "w": width,
                "h": height,
                "fl_x": float(image.K[0, 0]),
                "fl_y": float(image.K[1, 1]),
                "cx": float(image.K[0, 2]),
                "cy": float(image.K[1, 2]),
            }
            if any(image.distortion):
                frame.update(zip(("k1", "k2", "p1", "p2", "k3"), image.distortion, strict=True))
            frames.append(frame)
        content: dict[str, object] = {"frames": frames}
        if any(image.split for image in images):
            for part, split in (("train", "train"), ("val", "test"), ("test", "test")):
                files = [f"images/{image.name}" for image in images if image.split == split]
                content[f"{part}_filenames"] = files
        if points is not None:
            content["ply_file_path"] = "points.ply"
            columns, kinds = [*points.T], [(axis, "<f4") for axis in "xyz"]
            if colours is not None:
                columns += [*colours.T]
                kinds += [(channel, "u1") for channel in ("red", "green", "blue")]
            table = np.rec.fromarrays(columns, dtype=kinds)
            PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(temporary / "points.ply")
        write_text(temporary / "transforms.json", json.dumps(content, indent=1) + "\n")
