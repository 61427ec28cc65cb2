"""Check that the binary files of a COLMAP model are complete.

pycolmap does not check record counts: a truncated file or wrong count makes it allocate unlimited memory.
"""

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

from hilsplat.base.errors import SceneError

PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 2, 3, 3, 4, 6, 5)
"""Number of lens parameters, by COLMAP's camera model id."""
POSE_BYTES = 56
"""Size of a quaternion and a translation."""


class _Walk:
    """A position in a file that advances over its records."""

    def __init__(self, data: bytes | mmap.mmap) -> None:
        self.data, self.at = data, 0

    def number(self, form: str) -> int:
        """Read a number."""
        (found,) = struct.unpack_from(f"<{form}", self.data, self.at)
        self.at += struct.calcsize(f"<{form}")
        return int(found)

    def skip(self, count: int) -> None:
        """Advance by a number of bytes, and fail beyond the end of the file."""
        self.at += count
        if self.at > len(self.data):
            raise ValueError("it is truncated")


def _camera(walk: _Walk) -> None:
    walk.skip(4)
    model = walk.number("i")
    if not 0 <= model < len(PARAMETERS):
        raise ValueError(f"camera model {model} is unknown")
    walk.skip(16 + 8 * PARAMETERS[model])


def _image(walk: _Walk) -> None:
    walk.skip(4 + POSE_BYTES + 4)
    end = walk.data.find(b"\0", walk.at)
    if end < 0:
        raise ValueError("a name is not terminated")
    walk.at = end + 1
    walk.skip(24 * walk.number("Q"))


def _point(walk: _Walk) -> None:
    walk.skip(43)
    walk.skip(8 * walk.number("Q"))


def _rig(walk: _Walk) -> None:
    walk.skip(4)
    sensors = walk.number("I")
    if sensors:
        walk.skip(8)
    for _ in range(sensors - 1):
        walk.skip(8)
        if walk.number("B"):
            walk.skip(POSE_BYTES)


def _frame(walk: _Walk) -> None:
    walk.skip(8 + POSE_BYTES)
    walk.skip(16 * walk.number("I"))


RECORDS: dict[str, Callable[[_Walk], None]] = {
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
            _walk(path, record)
        except (ValueError, struct.error) as error:
            raise SceneError(
                f"{path} is damaged: {error}", fix="copy it again, or export the model again with COLMAP"
            ) from error


def _walk(path: Path, record: Callable[[_Walk], None]) -> None:
    if not path.stat().st_size:
        raise ValueError("it is empty")
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        walk = _Walk(data)
        count = walk.number("Q")
        if count > len(data):
            raise ValueError(f"it states {count} records in {len(data)} bytes")
        for number in range(count):
            try:
                record(walk)
            except struct.error as error:
                raise ValueError(f"it ends in record {number + 1} of {count}") from error
        if walk.at != len(data):
            raise ValueError(f"{len(data) - walk.at} bytes follow its {count} records")
