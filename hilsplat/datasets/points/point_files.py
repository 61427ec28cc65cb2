"""Readers for file formats of labelled points; each raises SceneError if a file is missing or damaged."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyParseError

from hilsplat.base.errors import SceneError
from hilsplat.datasets.dataset import listing
from hilsplat.scene import layouts

UNPACK_AGAIN = "unpack or download it again; the copy is incomplete"


def require_file(path: Path, fix: str = UNPACK_AGAIN) -> Path:
    """Return the path of a file that must exist; the error lists what its folder contains."""
    if not path.is_file():
        raise SceneError(f"{path} is missing", found=listing(path.parent), fix=fix)
    return path


def read_json_object(path: Path, keys: tuple[str, ...]) -> dict:
    """Read a JSON object that must have the given keys."""
    content = layouts.read_json_object(require_file(path), UNPACK_AGAIN)
    if not content.keys() >= set(keys):
        raise SceneError(
            f"{path} does not have the expected content",
            expected=f"an object with {', '.join(keys)}",
            found=", ".join(sorted(content)[:12]) or "an empty object",
            fix=UNPACK_AGAIN,
        )
    return content


def read_numbers(path: Path, columns: int) -> np.ndarray:
    """Read a text file of numbers, `columns` per line (inf and nan are allowed)."""
    require_file(path)
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != columns:
            raise SceneError(
                f"{path}, line {number} cannot be read",
                expected=f"{columns} numbers",
                found=line[:80],
                fix=UNPACK_AGAIN,
            )
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def read_matrix(path: Path) -> np.ndarray:
    """Read a 4 x 4 matrix from text."""
    matrix = read_numbers(path, 4)
    if len(matrix) != 4:
        raise SceneError(f"{path} is not a matrix", expected="4 lines", found=len(matrix), fix=UNPACK_AGAIN)
    return matrix


def read_ply(path: Path, corners: int) -> PlyData:
    """Read a mesh whose faces have `corners` corners each."""
    require_file(path)
    lists = {"face": {"vertex_indices": corners}}
    try:
        content = PlyData.read(path, known_list_len=lists)
        for element in ("vertex", "face"):
            content[element]  # KeyError if there is none
    except (PlyParseError, KeyError, ValueError, OSError) as error:
        raise SceneError(
            f"{path} cannot be read: {error}",
            expected=f"a PLY mesh with faces of {corners} corners",
            found=f"a file of {path.stat().st_size} bytes",
            fix=UNPACK_AGAIN,
        ) from error
    return content


def ply_column(path: Path, content: PlyData, element: str, name: str) -> np.ndarray:
    """Return a property of all vertices or faces, by name."""
    data = content[element].data
    if name not in data.dtype.names:
        raise SceneError(
            f"the {element} element of {path} has no property {name}",
            expected=name,
            found=", ".join(data.dtype.names),
            fix="use the labelled file that the data set distributes",
        )
    return np.asarray(data[name])


def ply_places(path: Path, content: PlyData) -> np.ndarray:
    """Return the vertices of a mesh, float32 (P, 3)."""
    columns = [ply_column(path, content, "vertex", axis) for axis in "xyz"]
    return np.stack(columns, axis=1).astype(np.float32)


def ply_faces(path: Path, content: PlyData) -> np.ndarray:
    """Return the corners of all faces, int32 (F, corners); each must be a vertex."""
    faces = ply_column(path, content, "face", "vertex_indices").astype(np.int32)
    count = len(content["vertex"].data)
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        raise SceneError(
            f"{path}: a face has a corner that is not a vertex",
            expected=f"0 to {count - 1}",
            found=f"{faces.min()} to {faces.max()}",
            fix=UNPACK_AGAIN,
        )
    return faces


def by_number(paths: Sequence[Path], prefix: str = "") -> list[tuple[int, Path]]:
    """Sort files by the number in their stem, after a prefix: 2 comes before 10."""
    numbered = []
    for path in paths:
        stem = path.stem.removeprefix(prefix)
        if not (stem.isascii() and stem.isdecimal()):
            raise SceneError(
                f"{path} is not named like a frame",
                expected=f"{prefix}<number>{path.suffix}",
                fix="move other images out of this folder",
            )
        numbered.append((int(stem), path))
    return sorted(numbered)
