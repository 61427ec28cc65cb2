"""Films: H.264 in MP4, which every player shows."""

from collections.abc import Iterable
from itertools import chain
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8

OPTIONS = {"crf": "20", "preset": "veryfast", "x264-params": "threads=1:mbtree=0"}
"""Macroblock-tree rate control gave other bytes each time, also on one thread (x264 in PyAV 18.1)."""


def write_film(path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], per_second: int) -> None:
    """Encode frames of one size; the same frames give the same bytes on the same version of PyAV.

    An odd last row or column is cut off: yuv420p needs even sides.

    Args:
        path: .mp4, in a temporary folder or file of an atomic writer.
        frames: at least one; taken one by one, so that a long film needs little memory.
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
            # converted here: the encoder's own conversion gives other bytes now and then
            picture = av.VideoFrame.from_ndarray(even, format="rgb24").reformat(format="yuv420p")
            film.mux(stream.encode(picture))
        film.mux(stream.encode())
