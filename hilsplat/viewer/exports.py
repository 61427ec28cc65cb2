"""Content of exported files (labels of Gaussians, masks of all views, films)."""

import io
import zipfile
from collections.abc import Generator, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Int32, Int64
from PIL import Image

from hilsplat.query.hits import NodeGroup
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.mask_files import mask_files
from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene
from hilsplat.splat.flyaround import FRAMES_PER_S, closed_path, encoded_film, open_path
from hilsplat.splat.gaussians import Gaussians
from hilsplat.viewer.frames import Paint, painted
from hilsplat.viewer.wire import Film

STEP = {"mp4": 1, "gif": 2}
"""Frame step of each format. GIFs use every second frame; with all frames, they are far larger than MP4s."""

Steps = Generator[tuple[int, int], None, bytes | partial[bytes]]
"""Generator that creates a file: it yields (steps done, total), starting at 0, and returns the file."""


def labelled(
    scene: LanguageScene, groups: Sequence[NodeGroup]
) -> tuple[Int64[np.ndarray, " g"], Int32[np.ndarray, " g"]]:
    """Return the rows of all groups' Gaussians in ascending order, and each row's group, numbered from 1.

    A Gaussian in several groups is assigned to the one with the fewest Gaussians.
    """
    members = [scene.views.gaussians_of(group.nodes) for group in groups]
    label = np.zeros(len(scene.gaussians), np.int32)
    for number in sorted(range(len(groups)), key=lambda number: -len(members[number])):
        label[members[number]] = number + 1
    rows = np.flatnonzero(label)
    return rows, label[rows]


def masks_zip(scene: LanguageScene, groups: Sequence[NodeGroup]) -> Steps:
    """Make a ZIP of the groups' node masks in all views (`query.mask_files`)."""
    total, content = len(scene.views.names), io.BytesIO()
    yield 0, total
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        of_views = mask_files(scene, groups)
        for done, files in enumerate(of_views, 1):
            for name, data in files.items():
                entry, how = (f"masks/{name}", zipfile.ZIP_STORED) if name.endswith(".png") else (name, None)
                archive.writestr(entry, data, how)
            yield done, total
    return content.getvalue()


def flight(asked: Film, scene: Scene) -> list[Camera]:
    """Return one camera per frame: along the film's path, or along a tour of the training cameras."""
    if len(asked.path) > 1:
        path = open_path([camera.camera() for camera in asked.path], asked.frames)
    else:
        views = scene.views("train") or scene.views()
        path = closed_path([scene.cameras[view] for view in views], asked.frames)
    height, width = path[0].size_hw
    scale = asked.side_px / max(height, width)
    size_hw = (max(2, round(height * scale / 2) * 2), max(2, round(width * scale / 2) * 2))
    return [camera.scaled(size_hw) for camera in path]


def film(
    gaussians: Gaussians, cameras: Sequence[Camera], paint: Paint | None, *, kind: str, threads: int
) -> Steps:
    """Make a film in one step per frame, in the colours of a style (None: the scene's own colours).

    Each frame has one camera, with an even image size; a GIF uses every second camera.
    """
    used = cameras[:: STEP[kind]]
    yield 0, len(used)
    pictures = (painted(gaussians, camera, paint, threads) for camera in used)
    with TemporaryDirectory() as folder:
        out = Path(folder) / f"film.{kind}"
        encoded = encoded_film(out, pictures) if kind == "mp4" else encoded_gif(out, pictures)
        for done, _ in enumerate(encoded, 1):
            yield done, len(used)
        return out.read_bytes()


def encoded_gif(path: Path, frames: Iterable[np.ndarray]) -> Iterator[None]:
    """Write a looping GIF with 256 colours chosen from the whole film, yielding after each frame.

    Dithering is off: on a synthetic table (128 colours) it lowered the quality from 41 dB to 35 dB, increased
    the size from 2.5 MB to 3.6 MB, and scattered dots over the answer.
    """
    film = []
    for frame in frames:
        film.append(frame)
        yield
    samples = min(len(film), 8)
    sheet = np.concatenate([film[number * len(film) // samples] for number in range(samples)])
    palette = Image.fromarray(sheet).quantize(256)
    first, *others = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in film
    ]
    duration_ms = round(1000 * STEP["gif"] / FRAMES_PER_S)
    first.save(path, save_all=True, append_images=others, duration=duration_ms, loop=0, optimize=False)
