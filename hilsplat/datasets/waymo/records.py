"""Waymo v1 (1.4.3): TFRecord files of Frame messages, read without TensorFlow.

Field numbers are those of waymo-research/waymo-open-dataset `dataset.proto`; only what is needed is read.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from hilsplat.base.errors import SceneError
from hilsplat.datasets.points.point_files import UNPACK_AGAIN, require_file
from hilsplat.datasets.waymo.frames import CAMERAS, TOP, CameraShot, LidarFrame, LidarReturn
from hilsplat.datasets.waymo.geometry import WaymoCamera, beam_inclinations

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
CRC_MASK_DELTA = 0xA282EAD8
CRC32C_POLYNOMIAL = 0x82F63B78


def fields_of(message: memoryview | bytes) -> dict[int, list[Any]]:
    """Fields of a message by number: integers for varints, views of bytes for all else, in order.

    Raises:
        ValueError: it is no message.
    """
    data = memoryview(message)
    fields: dict[int, list[Any]] = defaultdict(list)
    place = 0
    while place < len(data):
        key, place = _varint(data, place)
        kind = key & 7
        if kind == VARINT:
            value, place = _varint(data, place)
            fields[key >> 3].append(value)
            continue
        if kind == BYTES:
            length, place = _varint(data, place)
        elif kind in (FIXED64, FIXED32):
            length = 8 if kind == FIXED64 else 4
        else:
            raise ValueError(f"wire type {kind} in byte {place}")
        if place + length > len(data):
            raise ValueError("it ends inside a field")
        fields[key >> 3].append(data[place : place + length])
        place += length
    return fields


def _varint(data: memoryview, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if place >= len(data) or shift > 63:
            raise ValueError("it ends inside a number")
        byte = data[place]
        value |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return value, place


def packed_varints(data: memoryview | bytes) -> Int64[np.ndarray, " N"]:
    """Numbers of a packed field; negative ones take ten bytes and come back negative."""
    raw = np.frombuffer(data, dtype=np.uint8)
    if not raw.size:
        return np.zeros(0, dtype=np.int64)
    last = np.flatnonzero(raw < 128)
    if not last.size or last[-1] != len(raw) - 1:
        raise ValueError("it ends inside a number")
    first = np.concatenate([[0], last[:-1] + 1])
    digit = np.arange(len(raw)) - np.repeat(first, last - first + 1)
    if digit.max() > 9:
        raise ValueError("a number of more than ten bytes")
    parts = (raw & 127).astype(np.uint64) << (7 * digit).astype(np.uint64)
    return np.add.reduceat(parts, first).view(np.int64)


def doubles(values: list[Any]) -> Float[np.ndarray, " N"]:
    """A repeated field of doubles, packed or not."""
    return np.frombuffer(b"".join(bytes(value) for value in values), dtype="<f8")


def matrix(compressed: memoryview | bytes, whole_numbers: bool) -> np.ndarray:
    """A zlib-compressed MatrixInt32 or MatrixFloat, in its shape.

    Raises:
        ValueError: it is damaged, or the shape does not fit the values.
        zlib.error: it is damaged.
    """
    fields = fields_of(zlib.decompress(compressed))
    data = b"".join(bytes(value) for value in fields[1])
    values = packed_varints(data) if whole_numbers else np.frombuffer(data, dtype="<f4")
    shape: list[int] = []
    for value in fields_of(fields[2][0])[1]:
        shape.extend([value] if isinstance(value, int) else packed_varints(value).tolist())
    return values.reshape(shape).astype(np.int32 if whole_numbers else np.float32)


def _crc32c_table() -> list[int]:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte >> 1) ^ (CRC32C_POLYNOMIAL if byte & 1 else 0)
        table.append(byte)
    return table


_TABLE = _crc32c_table()


def masked_crc32c(data: bytes) -> int:
    """Checksum of a TFRecord: CRC-32C, turned by 15 bits, plus a constant.

    A loop over bytes: for the eight bytes of a length, not for the megabytes of a frame.
    """
    crc = 0xFFFFFFFF
    for byte in data:
        crc = _TABLE[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    crc ^= 0xFFFFFFFF
    return (((crc >> 15) | (crc << 17)) + CRC_MASK_DELTA) & 0xFFFFFFFF


def records(path: Path) -> Iterator[bytes]:
    """Records of a TFRecord file. Lengths are checked against their checksums, contents are not.

    Raises:
        SceneError: the file is missing, no TFRecord, or ends inside a record.
    """
    require_file(path)
    with path.open("rb") as stream:
        number = 0
        while head := stream.read(12):
            whole = len(head) == 12 and masked_crc32c(head[:8]) == struct.unpack("<I", head[8:])[0]
            data = stream.read(struct.unpack("<Q", head[:8])[0]) if whole else b""
            if not whole or len(data) < struct.unpack("<Q", head[:8])[0] or len(stream.read(4)) < 4:
                raise SceneError(
                    f"{path}: record {number} is damaged or cut off",
                    expected="a TFRecord file",
                    found=f"a file of {path.stat().st_size} bytes",
                    fix=UNPACK_AGAIN,
                )
            yield data
            number += 1


def frames(path: Path) -> Iterator[tuple[str, dict[int, list[Any]]]]:
    """Where each frame is, for messages, and its fields."""
    for number, record in enumerate(records(path)):
        where = f"{path}, frame {number}"
        try:
            yield where, fields_of(record)
        except ValueError as error:
            raise SceneError(f"{where} cannot be read: {error}", fix=UNPACK_AGAIN) from error


def first_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    """The vehicle's pose in the world at the first frame."""
    for where, frame in frames(path):
        return _transform(frame[3], where)
    raise SceneError(f"{path} holds no frame", fix=UNPACK_AGAIN)


def _transform(values: list[Any], where: str) -> np.ndarray:
    try:
        return doubles(fields_of(values[0])[1]).reshape(4, 4)
    except (ValueError, IndexError) as error:
        raise SceneError(f"{where}: a transform cannot be read: {error}", fix=UNPACK_AGAIN) from error


def lidar_frames(path: Path) -> Iterator[LidarFrame]:
    """The frames of a file whose top lidar is labelled.

    Raises:
        SceneError: the file is damaged.
    """
    for where, frame in frames(path):
        try:
            laser = _of_number(frame[5], TOP)
            calibration = _of_number(fields_of(frame[1][0])[3], TOP)
            returns, pixel_pose = [], None
            for number in (2, 3):
                if not laser[number]:
                    continue
                image = fields_of(laser[number][0])
                if image[4]:
                    pixel_pose = matrix(image[4][0], whole_numbers=False)
                labels = matrix(image[6][0], whole_numbers=True) if image[6] else None
                cells = matrix(image[3][0], whole_numbers=True) if image[3] else None
                returns.append(LidarReturn(matrix(image[2][0], whole_numbers=False), labels, cells))
            if all(part.labels is None for part in returns):
                continue
            if pixel_pose is None:
                raise SceneError(f"{where} has labels but no poses of pixels", fix=UNPACK_AGAIN)
            values = doubles(calibration[2]) if calibration[2] else None
            low, high = (doubles(calibration[number])[0] if calibration[number] else 0.0 for number in (3, 4))
            inclinations = beam_inclinations(values, float(low), float(high), pixel_pose.shape[0])
        except (ValueError, IndexError, zlib.error) as error:
            raise SceneError(f"{where} cannot be read: {error}", fix=UNPACK_AGAIN) from error
        yield LidarFrame(
            int(frame[2][0]),
            _transform(frame[3], where),
            _transform(calibration[5], where),
            inclinations,
            pixel_pose,
            tuple(returns),
        )


def _of_number(messages: list[Any], number: int) -> dict[int, list[Any]]:
    """The message whose field 1 is a number."""
    for message in messages:
        fields = fields_of(message)
        if fields[1] == [number]:
            return fields
    raise ValueError(f"it has nothing of sensor {number}")


def camera_shots(path: Path, every: int = 1) -> Iterator[CameraShot]:
    """Images by frame, then camera.

    Args:
        path: the file.
        every: take each n-th frame, all its cameras.

    Raises:
        SceneError: the file is damaged.
    """
    for number, (where, frame) in enumerate(frames(path)):
        if number % every:
            continue
        try:
            calibrations = fields_of(frame[1][0])[2]
            found = sorted((fields_of(image) for image in frame[4]), key=lambda image: image[1][0])
            for image in found:
                lens = _of_number(calibrations, image[1][0])
                camera = WaymoCamera(
                    CAMERAS[image[1][0] - 1],
                    doubles(lens[2]),
                    _transform(lens[3], where),
                    (int(lens[5][0]), int(lens[4][0])),
                )
                pose = _transform(image[3], where)
                yield CameraShot(int(frame[2][0]), camera, bytes(image[2][0]), pose)
        except (ValueError, IndexError) as error:
            raise SceneError(f"{where} cannot be read: {error}", fix=UNPACK_AGAIN) from error
