"""Reader of PLY files of other programs."""

import io
import re
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float64, UInt8
from plyfile import PlyData

from hilsplat.base.errors import foreign
from hilsplat.base.files import regular

MAX_HEADER_BYTES = 1 << 20

COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
"""Names of the columns with a point's colour."""


def read_ply(path: Path, corners: int | None = None) -> PlyData:
    """Read a PLY file; raise an exception if it is damaged, or has more rows than its header declares.

    plyfile ignores what follows the declared rows, so a wrong count would silently drop points.

    Args:
        corners: number of corners of every face, if all have the same, which is faster.
    """
    lengths = {} if corners is None else {"face": {"vertex_indices": corners}}
    with regular(path).open("rb") as file:
        stream = _with_plain_header(file)
        ply = PlyData.read(stream, known_list_len=lengths)
        if ply.text:
            _, *rows = re.split(rb"[\r\n]end_header", path.read_bytes(), maxsplit=1)[1].split(b"\n")
            if any(b"_" in row for row in rows):
                raise ValueError("a number contains an underscore")  # Python reads 1_0 as 10
            num_more = sum(map(bool, map(bytes.strip, rows))) - sum(element.count for element in ply)
        else:
            num_more = len(stream.read().strip())
    if num_more > 0:
        raise ValueError(f"{num_more} {'rows' if ply.text else 'bytes'} follow those declared in the header")
    return ply


def read_ply_points(path: Path) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Read the points of a PLY file, and their colours: integers, or floats from 0 to 1; grey without any."""
    fix = "copy it again, or remove it (or ply_file_path in the transforms file) to triangulate points"
    with foreign(f"{path}, with the points,", fix=fix):
        vertex = read_ply(path)["vertex"].data
        xyz = np.stack([vertex[axis] for axis in ("x", "y", "z")], axis=1).astype(np.float64)
        names = next((names for names in COLOURS if set(names) <= set(vertex.dtype.names)), None)
        if names is None:
            return xyz, np.full(xyz.shape, 128, dtype=np.uint8)
        rgb = np.stack([vertex[name] for name in names], axis=1)
        largest = float(np.nanmax(rgb)) if rgb.size else 0.0
        # Floats are usually in [0, 1], up to rounding; 16-bit colours of laser scanners may use only 8 bits.
        limit = 1 if rgb.dtype.kind == "f" and largest < 2 else 255 if largest <= 255 else 65535
        rgb = np.nan_to_num(rgb.astype(np.float64) * (255 / limit), nan=128.0)
    return xyz, np.clip(np.rint(rgb), 0, 255).astype(np.uint8)


def _with_plain_header(file: BinaryIO) -> BinaryIO:
    """Replace non-ASCII letters in the header, as in comments that name a texture: plyfile refuses them."""
    header = re.match(rb"ply.*?[\r\n]end_header", file.read(MAX_HEADER_BYTES), re.DOTALL)
    if header is None:
        raise ValueError(f"it is not a PLY file with a header of at most {MAX_HEADER_BYTES} bytes")
    file.seek(0)
    if header[0].isascii():
        return file
    plain = header[0].decode("ascii", "replace").encode("ascii", "replace")
    return io.BytesIO(plain + file.read()[len(header[0]) :])
