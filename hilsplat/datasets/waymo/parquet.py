"""Waymo v2 (2.0.1): one parquet file per component and segment, read with pyarrow.

All readers raise SceneError if a component is missing, damaged, or doesn't match the others.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hilsplat.base.errors import SceneError
from hilsplat.datasets.points.labelled_points import UNPACK_AGAIN, decoding, require_file
from hilsplat.datasets.waymo import frames

COMPONENTS = (
    "camera_image",
    "camera_calibration",
    "lidar",
    "lidar_calibration",
    "lidar_pose",
    "lidar_segmentation",
    "vehicle_pose",
)
INTRINSIC = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
FRAME, LASER, CAMERA = "key.frame_timestamp_micros", "key.laser_name", "key.camera_name"


def component_path(split: Path, tag: str, segment: str) -> Path:
    return split / tag / f"{segment}.parquet"


def num_images(path: Path) -> int:
    """Return the number of rows of component `camera_image`, from the file's footer."""
    import pyarrow.parquet as parquet

    with decoding(path):
        return int(parquet.read_metadata(path).num_rows)


def read_component(
    split: Path, tag: str, segment: str, columns: list[str], only: dict[str, int] | None = None
) -> list[dict[str, Any]]:
    """Return the rows of a component in file order, with lists converted to arrays.

    `only` maps columns to required values; rows with other values are not decoded.
    """
    import pyarrow.parquet as parquet

    path = component_path(split, tag, segment)
    require_file(path, f"download {tag}/{segment}.parquet from the same release")
    with decoding(path):
        names = parquet.read_schema(path).names
        lacking = [name for name in (*columns, *(only or {})) if name not in names]
        if lacking:
            raise SceneError(
                f"{path} is not component {tag} of release 2",
                expected=f"columns {', '.join(lacking)}",
                found=", ".join(names[:12]),
                fix="download the component again",
            )
        keep = [(name, "==", value) for name, value in (only or {}).items()]
        table = parquet.read_table(path, columns=columns, filters=keep or None, partitioning=None)
    return table.to_pandas(ignore_metadata=True, integer_object_nulls=True).to_dict("records")


def vehicle_poses(split: Path, segment: str) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return the vehicle's pose in the world at each frame's timestamp, in order of time."""
    name = "[VehiclePoseComponent].world_from_vehicle.transform"
    rows = read_component(split, "vehicle_pose", segment, [FRAME, name])
    with decoding(component_path(split, "vehicle_pose", segment)):
        return {row[FRAME]: _matrix4(row[name]) for row in sorted(rows, key=lambda row: row[FRAME])}


def _matrix4(values: Any) -> Float[np.ndarray, "4 4"]:
    return np.reshape(values, (4, 4)).astype(np.float64)


def lidar_frames(split: Path, segment: str) -> Iterator[frames.LidarFrame]:
    """Yield the labelled frames of a segment, in order."""
    poses = vehicle_poses(split, segment)
    calibration = "[LiDARCalibrationComponent]"
    extrinsic, beams = f"{calibration}.extrinsic.transform", f"{calibration}.beam_inclination"
    columns = [extrinsic, f"{beams}.min", f"{beams}.max", f"{beams}.values"]
    lidar = read_component(split, "lidar_calibration", segment, columns, {LASER: frames.TOP})
    if len(lidar) != 1:
        raise SceneError(
            f"lidar_calibration of {segment} has {len(lidar)} rows for the top lidar", fix=UNPACK_AGAIN
        )
    labelled = read_component(split, "lidar_segmentation", segment, [FRAME], {LASER: frames.TOP})
    for time in sorted(row[FRAME] for row in labelled):
        read = partial(_range_images, split, segment, time)
        images = read("lidar", "LiDARComponent", depth=4)
        labels = read("lidar_segmentation", "LiDARSegmentationLabelComponent", depth=2)
        (pixel_pose,) = read("lidar_pose", "LiDARPoseComponent", depth=6, returns=1)
        if time not in poses or pixel_pose is None:
            raise SceneError(f"segment {segment}, frame {time} has labels but no pose", fix=UNPACK_AGAIN)
        returns = tuple(
            frames.LidarReturn(image.astype(np.float32), label.astype(np.int32))
            for image, label in zip(images, labels, strict=True)
            if image is not None and label is not None
        )
        if not returns:
            continue
        with decoding(component_path(split, "lidar_calibration", segment)):
            values, lowest, highest = (lidar[0][f"{beams}.{name}"] for name in ("values", "min", "max"))
            inclinations = frames.beam_inclinations(values, lowest, highest, pixel_pose.shape[0])
            in_vehicle = _matrix4(lidar[0][extrinsic])
        pixel_pose = pixel_pose.astype(np.float32)
        yield frames.LidarFrame(time, poses[time], in_vehicle, inclinations, pixel_pose, returns)


def _range_images(
    split: Path, segment: str, time: int, tag: str, component: str, depth: int, returns: int = 2
) -> list[np.ndarray | None]:
    """Return the images (H x W x depth) of the top lidar's returns at a timestamp; None for null values."""
    names = [f"[{component}].range_image_return{number}" for number in range(1, returns + 1)]
    columns = [f"{name}.{part}" for name in names for part in ("values", "shape")]
    rows = read_component(split, tag, segment, columns, {FRAME: time, LASER: frames.TOP})
    if len(rows) != 1:
        raise SceneError(
            f"component {tag} of segment {segment} does not match lidar_segmentation",
            expected=f"one row for the top lidar at {time}",
            found=f"{len(rows)} rows",
            fix="download all components of the segment from the same release",
        )
    images: list[np.ndarray | None] = []
    for name in names:
        values, sizes = rows[0][f"{name}.values"], rows[0][f"{name}.shape"]
        if values is None or sizes is None:
            images.append(None)
            continue
        shape = tuple(int(size) for size in sizes)
        with decoding(f"segment {segment}, frame {time}: {name}", expected=f"height x width x {depth}"):
            height, width, _ = shape
            images.append(values.reshape(height, width, depth))
    return images


def _cameras(split: Path, segment: str) -> dict[int, frames.WaymoCamera]:
    base = "[CameraCalibrationComponent]"
    inner = [f"{base}.intrinsic.{name}" for name in INTRINSIC]
    extrinsic, width, height = f"{base}.extrinsic.transform", f"{base}.width", f"{base}.height"
    rows = read_component(split, "camera_calibration", segment, [CAMERA, *inner, extrinsic, width, height])
    with decoding(component_path(split, "camera_calibration", segment), expected="cameras 1 to 5 and lenses"):
        lenses = np.array([[row[name] for name in inner] for row in rows], dtype=np.float64)
        if not np.isfinite(lenses).all():
            raise ValueError("a lens is not finite")
        return {
            row[CAMERA]: frames.WaymoCamera(
                frames.CAMERAS[row[CAMERA]],
                lens,
                _matrix4(row[extrinsic]),
                (int(row[height]), int(row[width])),
            )
            for row, lens in zip(rows, lenses, strict=True)
        }


def camera_shots(split: Path, segment: str, every: int = 1) -> Iterator[frames.CameraShot]:
    """Yield the images of every n-th frame, sorted by time and camera."""
    cameras = _cameras(split, segment)
    pose = "[CameraImageComponent].pose.transform"
    rows = read_component(split, "camera_image", segment, [FRAME])
    for time in sorted({row[FRAME] for row in rows})[::every]:
        columns = [CAMERA, "[CameraImageComponent].image", pose]
        of_frame = read_component(split, "camera_image", segment, columns, {FRAME: time})
        for row in sorted(of_frame, key=lambda row: row[CAMERA]):
            expected = "images of the cameras in camera_calibration, from the same release"
            with decoding(component_path(split, "camera_image", segment), expected=expected):
                camera, encoded = cameras[row[CAMERA]], bytes(row["[CameraImageComponent].image"])
                shot = frames.CameraShot(time, camera, encoded, _matrix4(row[pose]))
            yield shot
