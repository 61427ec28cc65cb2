"""Reader of COLMAP models, binary and text, as COLMAP and other programs write them.

pycolmap's reader allocates unlimited memory for wrong counts, ends names at the first space, and expects
every detail of the text format. Rigs and frames are not read, because images have their own poses.
"""

import io
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from hilsplat.base.errors import SceneError, foreign
from hilsplat.base.files import regular
from hilsplat.scene.cameras import Photo
from hilsplat.scene.colmap import pycolmap, rotation_matrix
from hilsplat.scene.importers.ply_file import read_ply_points
from hilsplat.scene.layouts import model_files

FIX = "copy it again, or export the model again with COLMAP"

PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
"""Number of lens parameters, by COLMAP's camera model id."""

Row = TypeVar("Row")


@dataclass(frozen=True, eq=False)
class ModelImage:
    """A registered image; its pose is NaN if the quaternion in the file is not a rotation.

    Attributes:
        seen: observed position, px, and point id of each observation of a point.
    """

    name: str
    camera_id: int
    cam_from_world: Float64[np.ndarray, "4 4"]
    seen: tuple[Float64[np.ndarray, "n 2"], Int64[np.ndarray, " n"]]


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A COLMAP model; points are sorted by id, and None if the model has no file of points."""

    lenses: dict[int, Photo]
    images: list[ModelImage]
    points: tuple[Int64[np.ndarray, " P"], Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]] | None


def read_model(folder: Path) -> ColmapModel:
    """Read a model; raise SceneError with file and record or line if a file is damaged."""
    cameras, images, *points = model_files(folder)
    cloud = points.pop() if points and points[0].suffix == ".ply" else None
    if cameras.suffix == ".bin":
        lenses, records = _binary(cameras, _binary_lens), _binary(images, _binary_image)
        rows = _binary(points[0], _binary_point) if points else []
    else:
        lenses = _text(cameras, "CAMERA_ID MODEL WIDTH HEIGHT, and all parameters of the model", _text_lens)
        records = _text_images(images)
        rows = _text(points[0], "POINT3D_ID X Y Z R G B ...", _text_point) if points else []
    if len(dict(lenses)) < len(set(lenses)):
        raise SceneError(f"{cameras} has different cameras with the same id", fix=FIX)
    table = np.array(rows, np.float64).reshape(-1, 7)
    table = table[np.argsort(table[:, 0], kind="stable")]
    if (table[:, 4:] % 1).any():  # scripts write colours from 0 to 1
        if table[:, 4:].max() > 1:
            raise SceneError(f"{points[0]} has colours that are neither whole numbers nor at most 1", fix=FIX)
        table[:, 4:] = np.rint(255 * table[:, 4:])
    arrays = table[:, 0].astype(np.int64), table[:, 1:4], table[:, 4:].astype(np.uint8)
    if cloud is not None:
        xyz, rgb = read_ply_points(cloud)
        arrays = np.arange(-len(xyz), 0), xyz, rgb  # no image observes these ids
    return ColmapModel(dict(lenses), records, arrays if points or cloud else None)


def _image(
    name: str, camera_id: int, pose: Sequence[float], xy: np.ndarray, point_ids: np.ndarray
) -> ModelImage:
    """Return an image, given quaternion (wxyz) and translation, and its observations (point id -1: none)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix((*pose[1:4], pose[0])), pose[4:]
    is_point = point_ids >= 0
    return ModelImage(name, camera_id, matrix, (xy[is_point], point_ids[is_point]))


# -- binary ---------------------------------------------------------------------------------------


def _take(file: io.BytesIO, form: str) -> tuple[Any, ...]:
    """Read numbers laid out as `form`; raise struct.error past the end."""
    return struct.unpack(f"<{form}", file.read(struct.calcsize(f"<{form}")))


def _binary(path: Path, record: Callable[[io.BytesIO], Row]) -> list[Row]:
    """Read each record of a file, which must end after the last one."""
    rows: list[Row] = []
    with foreign(path, fix=FIX):
        file = io.BytesIO(regular(path).read_bytes())
        (count,) = _take(file, "Q")
        if count > (size := len(file.getvalue())):
            raise ValueError(f"it declares {count} records but has only {size} bytes")
        for number in range(count):
            try:
                rows.append(record(file))
            except (struct.error, ValueError) as error:
                reason = "it ends" if isinstance(error, struct.error) else f"{error}"
                raise ValueError(f"{reason} within record {number + 1} of {count}") from error
        if num_more := len(file.read()):
            raise ValueError(f"{num_more} bytes follow its {count} records")
    return rows


def _binary_lens(file: io.BytesIO) -> tuple[int, Photo]:
    number, model, width, height = _take(file, "IiQQ")
    if not 0 <= model < len(PARAMETERS):
        raise ValueError(f"unknown camera model {model}")
    params = _take(file, f"{PARAMETERS[model]}d")
    return number, Photo(pycolmap.CameraModelId(model).name, params, (height, width))


def _binary_image(file: io.BytesIO) -> ModelImage:
    _, *pose, camera_id = _take(file, "I7dI")
    (name,) = _take(file, f"{file.getvalue().index(0, file.tell()) - file.tell()}sx")
    (count,) = _take(file, "Q")
    (points,) = _take(file, f"{24 * count}s")
    seen = np.frombuffer(points, [("xy", "<f8", 2), ("id", "<i8")])
    return _image(name.decode("utf-8", "surrogateescape"), camera_id, pose, seen["xy"], seen["id"])


def _binary_point(file: io.BytesIO) -> tuple[float, ...]:
    *point, _, length = _take(file, "Q3d3BdQ")
    _take(file, f"{8 * length}x")
    return tuple(map(float, point))


# -- text -----------------------------------------------------------------------------------------


def _text(path: Path, expected: str, record: Callable[[str], Row]) -> list[Row]:
    """Read each line of a file that is neither blank nor a comment."""
    rows = []
    with foreign(path, fix=FIX):
        text = regular(path).read_text(encoding="utf-8-sig", errors="surrogateescape")
    for number, line in enumerate(text.split("\n"), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            if any("_" in cell and not cell[0].isalpha() for cell in line.split(maxsplit=9)[:9]):
                raise ValueError  # Python reads 1_0 as 10
            rows.append(record(line.strip()))
        except (ArithmeticError, LookupError, ValueError) as error:
            where = f"{path}, line {number}, cannot be read"
            raise SceneError(where, expected=expected, found=repr(line[:80]), fix=FIX) from error
    return rows


def _text_lens(line: str) -> tuple[int, Photo]:
    number, model, width, height, *params = line.split()
    model_id = int(pycolmap.CameraModelId.__members__.get(model, pycolmap.CameraModelId.INVALID))
    if model_id < 0 or len(params) != PARAMETERS[model_id] or "_" in "".join(params):
        raise ValueError
    return int(number), Photo(model, tuple(map(float, params)), (int(height), int(width)))


def _text_point(line: str) -> tuple[float, ...]:
    number, *cells = line.split(maxsplit=7)[:7]
    x, y, z, *rgb = map(float, cells)
    if len(rgb) != 3 or not all(0 <= value <= 255 for value in rgb):
        raise ValueError
    return float(int(number)), x, y, z, *rgb


def _text_images(path: Path) -> list[ModelImage]:
    """Read images.txt; the second line of an image, its points, may be missing."""
    expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line with X Y POINT3D_ID for each point"
    images: list[tuple[str, int, tuple[float, ...]]] = []
    tables: list[np.ndarray] = []  # of points, by image

    def read(line: str) -> None:
        if len(tables) < len(images):
            try:
                tables.append(np.array(line.split(), np.float64).reshape(-1, 3))
                return
            except ValueError:
                tables.append(np.zeros((0, 3)))
        *numbers, name = line.split(maxsplit=9)
        int(numbers[0])
        images.append((name, int(numbers[8]), tuple(map(float, numbers[1:8]))))

    _text(path, expected, read)
    tables.append(np.zeros((0, 3)))  # for the last image
    return [
        _image(*image, table[:, :2], table[:, 2].astype(np.int64))
        for image, table in zip(images, tables, strict=False)
    ]
