"""Write renders as films (H.264 in MP4, playable everywhere) and contact sheets."""

from collections.abc import Iterable
from itertools import chain
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8

MAX_SIDE_PX = 320
"""Longer side of a picture on a contact sheet."""
GAP_PX = 4

OPTIONS = {"crf": "20", "preset": "veryfast", "x264-params": "threads=1:mbtree=0"}
"""Macroblock-tree rate control is off: its bytes differ between runs, even on one thread (PyAV 18.1)."""


def write_film(path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], per_second: int) -> None:
    """Encode frames of one size; equal frames give equal bytes with the same version of PyAV.

    An odd last row or column is cropped: yuv420p needs even sides.

    Args:
        path: .mp4 file, in a temporary folder or file of an atomic writer.
        frames: at least one; consumed one by one, so that a long film needs little memory.
    """
    frames = iter(frames)
    first = next(frames)
    height, width = (side // 2 * 2 for side in first.shape[:2])
    with av.open(path, "w", format="mp4", options={"movflags": "faststart", "fflags": "bitexact"}) as film:
        stream = film.add_stream("libx264", rate=per_second, options=OPTIONS)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.flags |= av.codec.context.Flags.bitexact
        for frame in chain([first], frames):
            even = np.ascontiguousarray(frame[:height, :width])
            # the encoder's own conversion occasionally gives other bytes
            picture = av.VideoFrame.from_ndarray(even, format="rgb24").reformat(format="yuv420p")
            film.mux(stream.encode(picture))
        film.mux(stream.encode())


def contact_sheet(
    pictures: list[UInt8[np.ndarray, "_ _ 3"]], columns: int, max_side_px: int = MAX_SIDE_PX
) -> UInt8[np.ndarray, "H W 3"]:
    """Arrange pictures on a white sheet, row by row, shrunk by whole factors to at most `max_side_px`."""
    cells = [_shrunk(picture, -(-max(picture.shape[:2]) // max_side_px)) for picture in pictures]
    height, width = (max(cell.shape[axis] for cell in cells) + GAP_PX for axis in (0, 1))
    rows = -(-len(cells) // columns)
    sheet = np.full((rows * height, min(columns, len(cells)) * width, 3), 255, np.uint8)
    for k, cell in enumerate(cells):
        y, x = (k // columns) * height, (k % columns) * width
        sheet[y : y + cell.shape[0], x : x + cell.shape[1]] = cell
    return sheet


def _shrunk(picture: UInt8[np.ndarray, "_ _ 3"], factor: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Average blocks of factor x factor pixels; incomplete blocks at the border are cropped."""
    if factor <= 1:
        return picture
    height, width = (side // factor for side in picture.shape[:2])
    blocks = picture[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)
