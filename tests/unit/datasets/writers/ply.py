"""Write a mesh as a binary PLY."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement


def write_ply(
    path: Path, vertices: Mapping[str, np.ndarray], faces: np.ndarray, of_faces: Mapping[str, np.ndarray]
) -> None:
    """Write a binary little-endian mesh: columns of vertices, corners of faces, columns of faces."""
    elements = [
        PlyElement.describe(_table(columns), name)
        for name, columns in (("vertex", vertices), ("face", {"vertex_indices": faces, **of_faces}))
    ]
    PlyData(elements, byte_order="<").write(path)


def _table(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    kinds = [(name, column.dtype, column.shape[1:]) for name, column in columns.items()]
    rows = np.empty(len(next(iter(columns.values()))), dtype=kinds)
    for name, column in columns.items():
        rows[name] = column
    return rows
