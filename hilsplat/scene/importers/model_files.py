"""Check that the binary files of a COLMAP model are complete.

pycolmap does not check record counts: a truncated file or a wrong count makes it allocate unlimited memory.
"""

import mmap
import os
import struct
from collections.abc import Callable
from pathlib import Path

from hilsplat.base.errors import SceneError
from hilsplat.base.files import regular

PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 2, 3, 3, 4, 6, 5)
"""Number of lens parameters, by COLMAP's camera model id."""
POSE_BYTES = 56
"""Size of a quaternion and a translation."""


def _number(data: mmap.mmap, form: str) -> int:
    """Read bytes laid out as `form`, and return their only number; raise struct.error past the file's end."""
    (found,) = struct.unpack(f"<{form}", data.read(struct.calcsize(f"<{form}")))
    return int(found)


def _skip(data: mmap.mmap, count: int) -> None:
    """Advance by a number of bytes; raise struct.error beyond the end of the file."""
    if count > len(data) - data.tell():
        raise struct.error
    data.seek(count, os.SEEK_CUR)


def _camera(data: mmap.mmap) -> None:
    model = _number(data, "4xi16x")
    if not 0 <= model < len(PARAMETERS):
        raise ValueError(f"camera model {model} is unknown")
    _skip(data, 8 * PARAMETERS[model])


def _image(data: mmap.mmap) -> None:
    _skip(data, 4 + POSE_BYTES + 4)
    end = data.find(b"\0")
    if end < 0:
        raise ValueError("an image name is not terminated")
    data.seek(end + 1)
    _skip(data, 24 * _number(data, "Q"))


def _point(data: mmap.mmap) -> None:
    _skip(data, 8 * _number(data, "43xQ"))


def _rig(data: mmap.mmap) -> None:
    sensors = _number(data, "4xI")
    _skip(data, 8 * min(sensors, 1))
    for _ in range(sensors - 1):
        if _number(data, "8xB"):
            _skip(data, POSE_BYTES)


def _frame(data: mmap.mmap) -> None:
    _skip(data, 16 * _number(data, f"{8 + POSE_BYTES}xI"))


RECORDS: dict[str, Callable[[mmap.mmap], None]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}


def require_whole_files(folder: Path) -> None:
    """Check that each binary file of a COLMAP model ends exactly after its records."""
    for name, record in RECORDS.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        try:
            _require_whole(path, record)
        except (ValueError, struct.error) as error:
            raise SceneError(
                f"{path} is damaged: {error}", fix="copy it again, or export the model again with COLMAP"
            ) from error


def _require_whole(path: Path, record: Callable[[mmap.mmap], None]) -> None:
    with regular(path).open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        count = _number(data, "Q")
        if count > len(data):
            raise ValueError(f"it declares {count} records but has only {len(data)} bytes")
        for number in range(count):
            try:
                record(data)
            except struct.error as error:
                raise ValueError(f"it ends within record {number + 1} of {count}") from error
        if rest := len(data) - data.tell():
            raise ValueError(f"{rest} bytes follow its {count} records")
