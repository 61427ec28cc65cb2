"""Write a mesh as a binary PLY."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

PLY_TYPES = {"f4": "float", "u1": "uchar", "u2": "ushort", "i4": "int"}


def write_ply(
    path: Path, vertices: Mapping[str, np.ndarray], faces: np.ndarray, of_faces: Mapping[str, np.ndarray]
) -> None:
    """Write a binary little-endian mesh: columns of vertices, corners of faces, columns of faces.

    Written without plyfile, which reads it back and would take a Python step per face.
    """
    names = [(name, f"<{column.dtype.str[1:]}") for name, column in vertices.items()]
    rows = np.empty(len(next(iter(vertices.values()))), dtype=names)
    for name, column in vertices.items():
        rows[name] = column
    more = [(name, f"<{column.dtype.str[1:]}") for name, column in of_faces.items()]
    polygons = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", faces.shape[1:]), *more])
    polygons["count"], polygons["corners"] = faces.shape[1], faces
    for name, column in of_faces.items():
        polygons[name] = column
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *(f"property {PLY_TYPES[column.dtype.str[1:]]} {name}" for name, column in vertices.items()),
        f"element face {len(polygons)}",
        "property list uchar int vertex_indices",
        *(f"property {PLY_TYPES[column.dtype.str[1:]]} {name}" for name, column in of_faces.items()),
        "end_header\n",
    ]
    path.write_bytes("\n".join(header).encode() + rows.tobytes() + polygons.tobytes())
