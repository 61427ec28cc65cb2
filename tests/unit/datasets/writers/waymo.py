"""Write a drive in the layout of Waymo's release 2, so that its reader can be held to something known."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.artifacts import atomic_path
from hilsplat.datasets.waymo.frames import CAMERAS, TOP, CameraShot, LidarFrame
from hilsplat.datasets.waymo.parquet import CAMERA, FRAME, INTRINSIC, LASER, component_path

SEGMENT = "key.segment_context_name"


def write_segment(
    split: Path, segment: str, frames: Sequence[LidarFrame], shots: Sequence[CameraShot]
) -> None:
    """Write the components of a segment. All frames share the pose of the lidar and its beams.

    Args:
        split: folder such as `validation`.
        segment: context name.
        frames: at least one; its inclinations are stored, lowest first as Waymo does.
        shots: images; each camera's calibration is taken from its first one.
    """
    lidar, camera_of = frames[0], {shot.camera.name: shot.camera for shot in reversed(shots)}

    def write(tag: str, rows: Sequence[Mapping[str, Any]]) -> None:
        _write_component(component_path(split, tag, segment), [{SEGMENT: segment, **row} for row in rows])

    keys = [{FRAME: frame.timestamp_micros} for frame in frames]
    lasers = [{**key, LASER: TOP} for key in keys]
    write(
        "vehicle_pose",
        [
            {**key, "[VehiclePoseComponent].world_from_vehicle.transform": _matrix(frame.world_from_vehicle)}
            for key, frame in zip(keys, frames, strict=True)
        ],
    )
    base = "[LiDARCalibrationComponent]"
    beams = lidar.inclinations[::-1]
    calibration = {
        LASER: TOP,
        f"{base}.extrinsic.transform": _matrix(lidar.vehicle_from_lidar),
        f"{base}.beam_inclination.min": float(beams[0]),
        f"{base}.beam_inclination.max": float(beams[-1]),
        f"{base}.beam_inclination.values": beams.astype(np.float64),
    }
    write("lidar_calibration", [calibration])
    write(
        "lidar", [_returns("LiDARComponent", key, f, "image") for key, f in zip(lasers, frames, strict=True)]
    )
    write(
        "lidar_segmentation",
        [
            _returns("LiDARSegmentationLabelComponent", key, frame, "labels")
            for key, frame in zip(lasers, frames, strict=True)
        ],
    )
    if all(part.projection is not None for frame in frames for part in frame.returns):
        write(
            "lidar_camera_projection",
            [
                _returns("LiDARCameraProjectionComponent", key, frame, "projection", np.float32)
                for key, frame in zip(lasers, frames, strict=True)
            ],
        )
    write(
        "lidar_pose",
        [
            {**key, **_cells("[LiDARPoseComponent].range_image_return1", frame.pixel_pose)}
            for key, frame in zip(lasers, frames, strict=True)
        ],
    )
    write("camera_calibration", [_calibration(camera) for camera in camera_of.values()])
    write(
        "camera_image",
        [
            {
                FRAME: shot.timestamp_micros,
                CAMERA: CAMERAS.index(shot.camera.name) + 1,
                "[CameraImageComponent].image": shot.encoded,
                "[CameraImageComponent].pose.transform": _matrix(shot.world_from_vehicle),
            }
            for shot in shots
        ],
    )


def _matrix(transform: np.ndarray) -> np.ndarray:
    return np.asarray(transform, dtype=np.float64).ravel()


def _cells(name: str, image: np.ndarray | None) -> dict[str, Any]:
    if image is None:
        return {f"{name}.values": None, f"{name}.shape": None}
    return {f"{name}.values": image.ravel(), f"{name}.shape": np.array(image.shape, dtype=np.int32)}


def _returns(
    component: str, key: Mapping[str, Any], frame: LidarFrame, part: str, dtype: type | None = None
) -> dict[str, Any]:
    row = dict(key)
    for number in (1, 2):
        image = getattr(frame.returns[number - 1], part) if len(frame.returns) >= number else None
        stored = image if image is None or dtype is None else image.astype(dtype)
        row.update(_cells(f"[{component}].range_image_return{number}", stored))
    return row


def _calibration(camera: Any) -> dict[str, Any]:
    base = "[CameraCalibrationComponent]"
    height, width = camera.size_hw
    lens = {f"{base}.intrinsic.{name}": float(v) for name, v in zip(INTRINSIC, camera.intrinsic, strict=True)}
    return {
        CAMERA: CAMERAS.index(camera.name) + 1,
        **lens,
        f"{base}.extrinsic.transform": _matrix(camera.vehicle_from_cam),
        f"{base}.width": width,
        f"{base}.height": height,
    }


def _write_component(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One row group, columns typed as the release types them."""
    import pyarrow as pa
    import pyarrow.parquet as parquet

    small = {CAMERA: pa.int8(), LASER: pa.int8(), FRAME: pa.int64()}
    columns = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        known = next((value for value in values if value is not None), None)
        if name in small:
            columns[name] = pa.array(values, type=small[name])
        elif isinstance(known, np.ndarray):
            columns[name] = pa.array(values, type=pa.list_(pa.from_numpy_dtype(known.dtype)))
        elif isinstance(known, int):
            columns[name] = pa.array(values, type=pa.int32())
        else:
            columns[name] = pa.array(values)
    with atomic_path(path) as temporary:
        parquet.write_table(pa.table(columns), temporary)
