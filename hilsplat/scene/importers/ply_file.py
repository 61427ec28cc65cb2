"""Reader of PLY files of other programs."""

import io
from pathlib import Path
from typing import BinaryIO

from plyfile import PlyData

from hilsplat.base.files import regular

MAX_HEADER_BYTES = 1 << 20


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
            rows = path.read_bytes().partition(b"end_header")[2].split(b"\n")[1:]
            if any(b"_" in row for row in rows):
                raise ValueError("a number contains an underscore")  # Python reads 1_0 as 10
            num_more = sum(map(bool, map(bytes.strip, rows))) - sum(element.count for element in ply)
        else:
            num_more = len(stream.read().strip())
    if num_more > 0:
        raise ValueError(f"{num_more} {'rows' if ply.text else 'bytes'} follow those declared in the header")
    return ply


def _with_plain_header(file: BinaryIO) -> BinaryIO:
    """Replace non-ASCII letters in the header, as in comments that name a texture: plyfile refuses them."""
    header = b""
    while (line := file.readline(MAX_HEADER_BYTES)) and len(header) < MAX_HEADER_BYTES:
        header += line
        if line.strip() == b"end_header":
            break
    if not header.startswith(b"ply"):
        raise ValueError("it is not a PLY file")
    if header.isascii():
        file.seek(0)
        return file
    return io.BytesIO(header.decode("ascii", "replace").encode("ascii", "replace") + file.read())
