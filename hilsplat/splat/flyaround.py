"""Smooth camera paths around a scene or through given cameras; videos and contact sheets of renders."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation, Slerp

from hilsplat.base.images import write_png
from hilsplat.base.processes import in_order
from hilsplat.scene.cameras import Camera

FRAMES = 120
FRAMES_PER_S = 24
SHEET_FRAMES = 12
MAX_STOPS = 80
"""Maximum number of cameras that the path visits; if there are more, only every n-th is visited."""
SMOOTHING = 1 / 40
"""Width of the smoothing as a share of the tour; smoothing removes the shake of hand-held cameras."""

MAX_SIDE_PX = 320  # longer side of a picture on a contact sheet
GAP_PX = 4
TITLE_PX = 15  # height of the line above a picture

OPTIONS = {"crf": "20", "preset": "veryfast", "x264-params": "threads=1:mbtree=0"}
"""Macroblock-tree rate control is off: its output differs between runs, even on one thread (PyAV 18.1)."""


def closed_path(cameras: list[Camera], frames: int) -> list[Camera]:
    """Return cameras along a closed tour of the given cameras that keeps translation and rotation small.

    The speed is constant. Position, viewing direction and up vector are smoothed along the tour. Intrinsics
    and image size are those of the first camera. A single camera is repeated.
    """
    stops = cameras[:: -(-len(cameras) // MAX_STOPS)]
    centres = np.stack([camera.centre for camera in stops])
    ahead = np.stack([camera.cam_from_world[2, :3] for camera in stops])
    down = np.stack([camera.cam_from_world[1, :3] for camera in stops])
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()) or 1.0
    order = short_round(cdist(*[np.concatenate([centres / spread, ahead], axis=1)] * 2))
    poses = np.concatenate([centres, spread * ahead, spread * down], axis=1)[order]
    # sample at constant speed and far more finely than the frames, smooth cyclically, then pick the frames
    steps = np.linalg.norm(np.diff(poses, axis=0, append=poses[:1]), axis=1) + 1e-9 * spread
    at = np.concatenate([[0], np.cumsum(steps)])
    fine = frames * 8
    where = np.linspace(0, at[-1], fine, endpoint=False)
    ring = np.concatenate([poses, poses[:1]])
    walked = np.stack([np.interp(where, at, column) for column in ring.T], axis=1)
    smooth = gaussian_filter1d(walked, SMOOTHING * fine, axis=0, mode="wrap")[::8]
    return [_camera(row, cameras[0]) for row in smooth]


def open_path(cameras: list[Camera], frames: int) -> list[Camera]:
    """Return cameras along a smooth curve through two or more given cameras, in order.

    Positions and intrinsics follow a monotone cubic spline, so that the path does not overshoot. Directions
    rotate at a constant rate between consecutive cameras. The image size is that of the first camera.
    """
    centres = np.stack([camera.centre for camera in cameras])
    turns = Rotation.from_matrix([camera.cam_from_world[:3, :3] for camera in cameras])
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()) or 1.0
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=1) / spread
    turned = (turns[1:] * turns[:-1].inv()).magnitude()
    at = np.concatenate([[0], np.cumsum(moved + turned + 1e-6)])
    where = np.linspace(0, at[-1], frames)
    lenses = np.stack([camera.scaled(cameras[0].size_hw).K.ravel() for camera in cameras])
    walked = PchipInterpolator(at, np.concatenate([centres, lenses], axis=1))(where)
    path = []
    for row, turn in zip(walked, Slerp(at, turns)(where).as_matrix(), strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ row[:3]
        path.append(Camera("path", pose, row[3:].reshape(3, 3), cameras[0].size_hw))
    return path


def _camera(row: Float64[np.ndarray, " 9"], like: Camera) -> Camera:
    """Build a camera from its centre, viewing direction and down direction, which need not be orthogonal."""
    forward = row[3:6] / max(np.linalg.norm(row[3:6]), 1e-12)
    down = row[6:] - forward * (row[6:] @ forward)
    if np.linalg.norm(down) < 1e-9:  # directions of opposite cameras cancel out
        down = like.cam_from_world[1, :3] - forward * (like.cam_from_world[1, :3] @ forward)
    down = down / max(np.linalg.norm(down), 1e-12)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(down, forward), down, forward])
    pose[:3, 3] = -pose[:3, :3] @ row[:3]
    return Camera("flyaround", pose, like.K, like.size_hw)


def short_round(distances: Float64[np.ndarray, "S S"]) -> list[int]:
    """Return a short closed tour, built from nearest neighbours and then improved by 2-opt."""
    number = len(distances)
    tour = [0]
    while len(tour) < number:
        tour.append(int(np.where(np.isin(range(number), tour), np.inf, distances[tour[-1]]).argmin()))
    improved = number > 3
    while improved:
        improved = False
        for i in range(number - 1):
            for j in range(i + 2, number - (i == 0)):
                a, b, c, d = tour[i], tour[i + 1], tour[j], tour[(j + 1) % number]
                gain = distances[a, b] + distances[c, d] - distances[a, c] - distances[b, d]
                if gain > 1e-9:
                    tour[i + 1 : j + 1] = tour[i + 1 : j + 1][::-1]
                    improved = True
    return tour


def write_flyaround(
    folder: Path, cameras: list[Camera], picture: Callable[[Camera], UInt8[np.ndarray, "H W 3"]], threads: int
) -> None:
    """Write `flyaround.mp4` and a contact sheet of every tenth frame, `flyaround.png`.

    Frames are rendered while earlier ones are encoded; the bytes do not depend on the number of threads.
    """
    rendered = in_order(picture, closed_path(cameras, FRAMES), threads)
    film = encoded_film(folder / "flyaround.mp4", rendered)
    samples = [frame for number, frame in enumerate(film) if number % (FRAMES // SHEET_FRAMES) == 0]
    write_png(folder / "flyaround.png", contact_sheet(samples, columns=4))


def encoded_film(
    path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]]
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Encode one or more frames of the same size as MP4, and yield each frame once it is encoded.

    With a given PyAV version, identical frames produce identical bytes. An odd last row or column is cropped,
    because yuv420p needs even sides. Frames are consumed one by one to save memory. The file is complete when
    the iterator ends, so `path` must be temporary or from an atomic writer.
    """
    import av  # lazy: a fit doesn't need it

    frames = iter(frames)
    first = next(frames)
    height, width = (side // 2 * 2 for side in first.shape[:2])
    with av.open(path, "w", format="mp4", options={"movflags": "faststart", "fflags": "bitexact"}) as film:
        stream = film.add_stream("libx264", rate=FRAMES_PER_S, options=OPTIONS)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.flags |= av.codec.context.Flags.bitexact
        for frame in chain([first], frames):
            even = np.ascontiguousarray(frame[:height, :width])
            # the encoder's own conversion is not always byte-identical
            picture = av.VideoFrame.from_ndarray(even, format="rgb24").reformat(format="yuv420p")
            film.mux(stream.encode(picture))
            yield frame
        film.mux(stream.encode())


def contact_sheet(
    pictures: list[UInt8[np.ndarray, "_ _ 3"]], columns: int, titles: Sequence[str] = ()
) -> UInt8[np.ndarray, "H W 3"]:
    """Shrink pictures by integer factors to at most MAX_SIDE_PX and arrange them in rows on a white sheet.

    Each picture may have a title above it; a long title loses its beginning, because file names differ at the
    end.
    """
    cells = [_shrunk(picture, -(-max(picture.shape[:2]) // MAX_SIDE_PX)) for picture in pictures]
    above = TITLE_PX if titles else 0
    height, width = (max(cell.shape[axis] for cell in cells) + GAP_PX for axis in (0, 1))
    height, rows = height + above, -(-len(cells) // columns)
    sheet = np.full((rows * height, min(columns, len(cells)) * width, 3), 255, np.uint8)
    places = [((k // columns) * height, (k % columns) * width) for k in range(len(cells))]
    for cell, (y, x) in zip(cells, places, strict=True):
        sheet[y + above : y + above + cell.shape[0], x : x + cell.shape[1]] = cell
    if not titles:
        return sheet
    image, font = Image.fromarray(sheet), ImageFont.load_default(TITLE_PX - GAP_PX)
    for title, (y, x) in zip(titles, places, strict=True):
        text = title
        while len(text) > 1 and font.getlength(text) > width - GAP_PX:
            text = f"…{text[2:]}"
        ImageDraw.Draw(image).text((x, y), text, fill=(0, 0, 0), font=font)
    return np.asarray(image)


def _shrunk(picture: UInt8[np.ndarray, "_ _ 3"], factor: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Average blocks of factor x factor pixels; incomplete blocks at the border are cropped."""
    height, width = (side // factor for side in picture.shape[:2])
    blocks = picture[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)
