"""Conversion of videos and archives into a folder of photographs."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import atomic_folder, read_json, write_json
from hilsplat.base.errors import SceneError
from hilsplat.base.files import VIDEO_SUFFIXES, list_images, list_videos
from hilsplat.scene.layouts import has_known_poses, photo_folder, unwrapped

MARK = ".made_from.json"
"""Hidden file that records the source files of a converted folder."""


@dataclass(frozen=True)
class PreparedFolder:
    """A folder to be registered as a scene's source.

    Attributes:
        folder: the folder.
        notes: sentences about the conversion and about skipped files.
    """

    folder: Path
    notes: tuple[str, ...] = ()


@contextmanager
def prepared_photographs(source: Path, target: Path, frames: int) -> Iterator[PreparedFolder]:
    """Yield the source folder of photographs itself, or `target`, made from videos or an archive.

    If the block ends with an error, a folder that was made is removed.

    Args:
        source: a folder of photographs or of videos only, a video, or a .zip (or Record3D's .r3d).
        target: folder to create if the source must be converted.
        frames: maximum number of frames taken from videos.

    Raises:
        SceneError: the source cannot be used, or the target exists and was made from other files.
    """
    source = Path(source)
    if not source.exists():
        raise SceneError(
            f"{source} is missing", fix="give a folder of photographs, a video, or a zip of photographs"
        )
    make: Callable[[Path], list[str]]
    if videos := _videos_of(source):

        def make(folder: Path) -> list[str]:
            from hilsplat.photos.video import extract_frames  # PyAV is slow to import

            named = ", ".join(video.name for video in videos)
            notes = extract_frames(videos, folder, frames)
            return [f"{len(list_images(folder))} frames of {named} are in {target}", *notes]

    elif source.is_dir():
        beside = list_videos(photo_folder(source))
        note = f"{len(beside)} videos beside the photographs (Live Photos) are not used" if beside else ""
        yield PreparedFolder(source, (note,) if note else ())
        return
    elif source.suffix.lower() in (".zip", ".r3d"):

        def make(folder: Path) -> list[str]:
            from hilsplat.photos.archive import unpack_photographs

            unpack_photographs(source, folder)
            return [f"{source.name} unpacked to {target}"]

    else:
        raise SceneError(
            f"{source} is a file of an unknown kind",
            expected=f"a folder of photographs, a video ({', '.join(sorted(VIDEO_SUFFIXES))}), or a .zip",
            fix="give the folder that holds the photographs",
        )
    mark = _mark(videos or [source], frames)
    if not target.exists():
        with atomic_folder(target) as folder:
            notes = make(folder)
            write_json(folder / MARK, mark)
    elif (target / MARK).is_file() and read_json(target / MARK) == mark:
        notes = [f"{target} is there already, from the same files"]  # an earlier run was killed later
    else:
        raise SceneError(
            f"{target} is in the way",
            fix="choose another name for the scene, or move that folder away",
        )
    try:
        yield PreparedFolder(unwrapped(target), tuple(notes))
    except BaseException:
        shutil.rmtree(target, ignore_errors=True)
        raise


def _mark(files: list[Path], frames: int) -> dict[str, Any]:
    found = [(file.name, (stat := file.stat()).st_size, stat.st_mtime_ns) for file in files]
    return {"files": [list(each) for each in found], "frames": frames}


def _videos_of(source: Path) -> list[Path]:
    """Return the videos to take frames from: the source itself, or those in a folder without photographs."""
    if source.is_file():
        return [source] if source.suffix.lower() in VIDEO_SUFFIXES else []
    if list_images(photo_folder(source)) or has_known_poses(source):
        return []
    return list_videos(source)
