"""Waymo v1 (1.4.3): TFRecord files of Frame messages, read without TensorFlow.

protobuf decodes the messages; this module reads the records around them, because the package `tfrecord` would
add two dependencies and allocate as much memory as a damaged record length states. All readers raise
SceneError if the file is missing, damaged or truncated.
"""

import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from jaxtyping import Float

from hilsplat.base.errors import SceneError
from hilsplat.datasets.points.labelled_points import UNPACK_AGAIN, decoding, require_file
from hilsplat.datasets.waymo.frames import (
    CAMERAS,
    TOP,
    CameraShot,
    LidarFrame,
    LidarReturn,
    WaymoCamera,
    beam_inclinations,
)

_FIELDS = """
MatrixShape: repeated int32 dims 1
MatrixFloat: repeated float data 1, optional MatrixShape shape 2
MatrixInt32: repeated int32 data 1, optional MatrixShape shape 2
Transform: repeated double transform 1
CameraCalibration: required int32 name 1, repeated double intrinsic 2, optional Transform extrinsic 3, \
    required int32 width 4, required int32 height 5
LaserCalibration: required int32 name 1, repeated double beam_inclinations 2, \
    optional double beam_inclination_min 3, optional double beam_inclination_max 4, \
    optional Transform extrinsic 5
Context: repeated CameraCalibration camera_calibrations 2, repeated LaserCalibration laser_calibrations 3
RangeImage: optional bytes range_image_compressed 2, optional bytes range_image_pose_compressed 4, \
    optional bytes segmentation_label_compressed 6
Laser: required int32 name 1, optional RangeImage ri_return1 2, optional RangeImage ri_return2 3
CameraImage: required int32 name 1, required bytes image 2, required Transform pose 3
Frame: required Context context 1, required int64 timestamp_micros 2, required Transform pose 3, \
    repeated CameraImage images 4, repeated Laser lasers 5
"""
"""Fields used from waymo-research/waymo-open-dataset `dataset.proto`, with its names and numbers. Fields that
are always present are marked as required."""


def message_classes(fields: str) -> dict[str, Any]:
    """Return message classes by name, from lines like `Frame: required int64 timestamp_micros 2, ...`."""
    field_type = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="waymo.proto", syntax="proto2")
    for line in fields.replace("\\\n", "").strip().splitlines():
        name, _, listed = line.partition(":")
        message = file.message_type.add(name=name)
        for entry in listed.split(","):
            label, kind, field, number = entry.split()
            added = message.field.add(
                name=field, number=int(number), label=field_type.Label.Value(f"LABEL_{label.upper()}")
            )
            if kind[0].isupper():
                added.type, added.type_name = field_type.TYPE_MESSAGE, f".{kind}"
            else:
                added.type = field_type.Type.Value(f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClassesForFiles([file.name], pool)


MESSAGES = message_classes(_FIELDS)


def matrix(compressed: bytes, dtype: type) -> np.ndarray:
    """Decode a zlib-compressed MatrixInt32 or MatrixFloat.

    Raises:
        DecodeError, zlib.error, ValueError: the data is damaged, or the shape does not match the values.
    """
    kind = MESSAGES["MatrixInt32" if dtype is np.int32 else "MatrixFloat"]
    unpacker = zlib.decompressobj()
    content = unpacker.decompress(compressed, 2**26)  # 16 times the largest matrix of Waymo
    if not unpacker.eof:
        raise ValueError("its data is truncated, or unpacks to more than 64 MiB")
    message = kind.FromString(content)
    return np.array(message.data, dtype=dtype).reshape(tuple(message.shape.dims))


def records(path: Path) -> Iterator[bytes]:
    """Yield the records of a TFRecord file, without their checksums."""
    require_file(path)
    left = path.stat().st_size
    with path.open("rb") as stream:
        number = 0
        while left:
            head = stream.read(12)
            length = struct.unpack("<Q", head[:8])[0] if len(head) == 12 else left
            left -= 12 + length + 4
            if left < 0:
                raise SceneError(
                    f"{path}: record {number} is damaged or truncated",
                    expected="a TFRecord file",
                    found=f"a file of {path.stat().st_size} bytes",
                    fix=UNPACK_AGAIN,
                )
            yield stream.read(length)
            stream.read(4)
            number += 1


def frames(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield the location of each frame, for messages, and the frame itself."""
    for number, record in enumerate(records(path)):
        where = f"{path}, frame {number}"
        with decoding(where):
            frame = MESSAGES["Frame"].FromString(record)
        yield where, frame


def first_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    """Return the vehicle's pose in the world in the first frame."""
    for where, frame in frames(path):
        with decoding(where):
            return _matrix4(frame.pose)
    raise SceneError(f"{path} contains no frames", fix=UNPACK_AGAIN)


def _matrix4(transform: Any) -> np.ndarray:
    return np.array(transform.transform, dtype=np.float64).reshape(4, 4)


def lidar_frames(path: Path) -> Iterator[LidarFrame]:
    """Yield a file's frames that have labels for the top lidar."""
    for where, frame in frames(path):
        with decoding(where):
            laser = _named(frame.lasers, TOP)
            calibration = _named(frame.context.laser_calibrations, TOP)
            returns = tuple(
                LidarReturn(
                    matrix(image.range_image_compressed, np.float32),
                    matrix(image.segmentation_label_compressed, np.int32),
                )
                for image in (laser.ri_return1, laser.ri_return2)
                if image.range_image_compressed and image.segmentation_label_compressed
            )
            if not returns:
                continue
            packed = laser.ri_return1.range_image_pose_compressed  # the second return has the same poses
            if not packed:
                raise SceneError(f"{where} has labels but no pixel poses", fix=UNPACK_AGAIN)
            pixel_pose = matrix(packed, np.float32)
            inclinations = beam_inclinations(
                np.array(calibration.beam_inclinations) if calibration.beam_inclinations else None,
                calibration.beam_inclination_min,
                calibration.beam_inclination_max,
                pixel_pose.shape[0],
            )
            in_world, in_vehicle = _matrix4(frame.pose), _matrix4(calibration.extrinsic)
        yield LidarFrame(frame.timestamp_micros, in_world, in_vehicle, inclinations, pixel_pose, returns)


def _named(messages: Iterable[Any], name: int) -> Any:
    for message in messages:
        if message.name == name:
            return message
    raise ValueError(f"no data from sensor {name}")


def camera_shots(path: Path, every: int = 1) -> Iterator[CameraShot]:
    """Yield the images of every n-th frame, sorted by frame and camera."""
    for number, (where, frame) in enumerate(frames(path)):
        if number % every:
            continue
        for image in sorted(frame.images, key=lambda image: image.name):
            with decoding(where):
                lens = _named(frame.context.camera_calibrations, image.name)
                name, size_hw = CAMERAS[image.name], (lens.height, lens.width)
                camera = WaymoCamera(name, np.array(lens.intrinsic), _matrix4(lens.extrinsic), size_hw)
                pose = _matrix4(image.pose)
            yield CameraShot(frame.timestamp_micros, camera, image.image, pose)
