"""Write a drive in the layout of Waymo's release 2."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet

from hilsplat.datasets.waymo.frames import CAMERAS, TOP, CameraShot, LidarFrame, WaymoCamera
from hilsplat.datasets.waymo.parquet import CAMERA, FRAME, INTRINSIC, LASER, component_path


def write_segment(
    split: Path, segment: str, frames: Sequence[LidarFrame], shots: Sequence[CameraShot]
) -> None:
    """Write the components of a segment. All frames share the pose of the lidar and its beams.

    Args:
        split: folder such as `validation`.
        frames: at least one; its inclinations are stored, lowest first as Waymo does.
        shots: images; each camera's calibration is taken from its first one.
    """

    def write(tag: str, rows: Sequence[Mapping[str, Any]]) -> None:
        _write_component(component_path(split, tag, segment), rows)

    pose = "[VehiclePoseComponent].world_from_vehicle.transform"
    write("vehicle_pose", [{FRAME: f.timestamp_micros, pose: f.world_from_vehicle.ravel()} for f in frames])
    base = "[LiDARCalibrationComponent]"
    beams = frames[0].inclinations[::-1]
    calibration = {
        LASER: TOP,
        f"{base}.extrinsic.transform": frames[0].vehicle_from_lidar.ravel(),
        f"{base}.beam_inclination.min": float(beams[0]),
        f"{base}.beam_inclination.max": float(beams[-1]),
        f"{base}.beam_inclination.values": beams.astype(np.float64),
    }
    write("lidar_calibration", [calibration])
    for tag, component, part, kind in (
        ("lidar", "LiDARComponent", "image", np.float32),
        ("lidar_segmentation", "LiDARSegmentationLabelComponent", "labels", np.int32),
        ("lidar_camera_projection", "LiDARCameraProjectionComponent", "projection", np.float32),
    ):
        images = [[getattr(each, part).astype(kind) for each in frame.returns] for frame in frames]
        write(tag, [_cells(component, *pair) for pair in zip(frames, images, strict=True)])
    write("lidar_pose", [_cells("LiDARPoseComponent", frame, [frame.pixel_pose]) for frame in frames])
    camera_of = {shot.camera.name: shot.camera for shot in reversed(shots)}
    write("camera_calibration", [_calibration(camera) for camera in camera_of.values()])
    write(
        "camera_image",
        [
            {
                FRAME: shot.timestamp_micros,
                CAMERA: CAMERAS.index(shot.camera.name) + 1,
                "[CameraImageComponent].image": shot.encoded,
                "[CameraImageComponent].pose.transform": shot.world_from_vehicle.ravel(),
            }
            for shot in shots
        ],
    )


def _cells(component: str, frame: LidarFrame, images: Sequence[np.ndarray]) -> dict[str, Any]:
    """A row of range images: values and shape of the first and second return, null if there is none."""
    row: dict[str, Any] = {FRAME: frame.timestamp_micros, LASER: TOP}
    for number in (1, 2):
        image = images[number - 1] if len(images) >= number else None
        name = f"[{component}].range_image_return{number}"
        row[f"{name}.values"] = None if image is None else image.ravel()
        row[f"{name}.shape"] = None if image is None else np.array(image.shape, dtype=np.int32)
    return row


def _calibration(camera: WaymoCamera) -> dict[str, Any]:
    base = "[CameraCalibrationComponent]"
    height, width = camera.size_hw
    lens = {f"{base}.intrinsic.{name}": float(v) for name, v in zip(INTRINSIC, camera.intrinsic, strict=True)}
    return {
        CAMERA: CAMERAS.index(camera.name) + 1,
        **lens,
        f"{base}.extrinsic.transform": camera.vehicle_from_cam.ravel(),
        f"{base}.width": width,
        f"{base}.height": height,
    }


def _write_component(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One row group, columns typed as the release types them."""
    small = {CAMERA: pa.int8(), LASER: pa.int8(), FRAME: pa.int64()}
    columns = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        kind = small.get(name)
        if isinstance(values[0], np.ndarray):
            kind = pa.list_(pa.from_numpy_dtype(values[0].dtype))
        columns[name] = pa.array(values, type=kind)
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pa.table(columns), path)
