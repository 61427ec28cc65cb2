"""Reader of PLY files of other programs."""

from pathlib import Path

from plyfile import PlyData

from hilsplat.base.files import regular


def read_ply(path: Path) -> PlyData:
    """Read a PLY file; raise an exception if it is damaged, or has more rows than its header declares.

    plyfile ignores what follows the declared rows, so a wrong count would silently drop points.
    """
    with regular(path).open("rb") as stream:
        ply = PlyData.read(stream)
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
