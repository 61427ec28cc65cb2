"""Conversion of videos and untrusted archives into folders of photographs."""

import os
import stat
import struct
import zipfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path, PurePosixPath

from hilsplat.base.artifacts import read_memo, write_json
from hilsplat.base.atomic import atomic_folder, require_free_space
from hilsplat.base.errors import HilsplatError, SceneError, foreign
from hilsplat.base.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES, is_outside, list_files, list_images
from hilsplat.base.lineage import CONVERTED
from hilsplat.base.removal import undone_on_error
from hilsplat.scene.layouts import UNREAD_GAUSSIANS, has_known_poses, photo_folder, unwrapped

MAX_FILES = 50_000
MAX_TOTAL_GIB = 20
"""Limits on the contents of an archive. A capture has a few hundred files and rarely exceeds a gigabyte."""

POSE_SUFFIXES = frozenset({".json", ".txt", ".bin", ".npy", ".ply"})
"""Suffixes of files that may contain poses or points; Record3D's `metadata` has no suffix."""


@contextmanager
def prepared_photographs(source: Path, target: Path, frames: int) -> Iterator[tuple[Path, list[str]]]:
    """Yield a scene's folder, and notes on its conversion and on skipped files.

    The source is a folder that contains photographs or only videos, a video, or a .zip (or Record3D's .r3d).
    A folder of photographs is used in place. Videos (at most `frames` frames in all) and archives are
    converted into a new folder at `target`; if the block raises an error, the files of a folder that this
    call made are removed.

    Raises:
        SceneError: the source cannot be used, or the target exists and was made from different files.
    """
    if not source.exists():
        raise SceneError(
            f"{source} is missing", fix="pass a folder of photographs, a video, or a zip of photographs"
        )
    source = unwrapped(source) if source.is_dir() else source
    videos = _videos_of(source)
    if source.is_dir() and not videos:
        beside = list_files(photo_folder(source), VIDEO_SUFFIXES)
        note = f"{len(beside)} videos beside the photographs (Live Photos) are not used"
        yield source, [note] if beside else []
        return
    if not videos and source.suffix.lower() not in (".zip", ".r3d"):
        fix = "pass the folder that contains the photographs; unpack other archives than .zip first"
        if source.suffix.lower() in (".ply", *UNREAD_GAUSSIANS):
            fix = "pass the folder of the photographs and their poses, and --gaussians with a 3DGS PLY"
        raise SceneError(
            f"{source} has an unsupported file type",
            expected=f"a folder of photographs, a video ({', '.join(sorted(VIDEO_SUFFIXES))}), or a .zip",
            fix=fix,
        )
    files = [[file.name, file.stat().st_size, file.stat().st_mtime_ns] for file in videos or [source]]
    mark = {"files": files, "frames": frames}
    is_new = not os.path.lexists(target)
    if is_new:
        with atomic_folder(target) as folder:
            if videos:
                from hilsplat.photos.video import extract_frames  # PyAV is slow to import

                notes = extract_frames(videos, folder, frames)
                named = ", ".join(video.name for video in videos)
                notes.insert(0, f"{len(list_images(folder))} frames of {named} extracted to {target}")
            else:
                unpack_photographs(source, folder)
                notes = [f"{source.name} unpacked to {target}"]
            write_json(folder / CONVERTED, mark)
    elif read_memo(target / CONVERTED, dict) == mark:
        notes = [f"{target} already exists and was made from the same files"]  # left by a run that was killed
    else:
        fix = "choose another name for the scene, or move that folder"
        raise SceneError(f"{target} already exists", fix=fix)
    with undone_on_error(target) if is_new else nullcontext():
        try:
            yield unwrapped(target), notes
        except HilsplatError as error:
            if is_new and not videos:  # the error names files that are about to be removed
                advice = f"unpack {source.name} yourself, and pass the folder of its photographs"
                error.add_line("note", f"{target} is removed again; to change its files, {advice}")
            raise


def _videos_of(source: Path) -> list[Path]:
    """Return the videos to extract frames from: the source, or those in a source without photographs."""
    if source.is_file():
        return [source] if source.suffix.lower() in VIDEO_SUFFIXES else []
    if list_images(photo_folder(source)) or has_known_poses(source):
        return []
    return list_files(source, VIDEO_SUFFIXES)


def unpack_photographs(archive: Path, folder: Path) -> None:
    """Unpack the images and pose files of a zip archive into an existing, empty folder.

    Every entry is checked before any file is written, and no file can exceed its declared size.

    Raises:
        SceneError: the file is not a zip archive, is damaged, encrypted or too large, or contains links or
            names that point outside the folder.
        DiskSpaceError: there is too little free space.
    """
    fix = "copy it again, or unpack it yourself and pass the folder"
    with (
        foreign(f"archive {archive}", problem="cannot be unpacked", fix=fix),
        zipfile.ZipFile(archive) as opened,
    ):
        listed = opened.infolist()
        if _num_listed(archive) not in (len(listed), 2**16 - 1):
            raise zipfile.BadZipFile(f"its list of files is damaged after {len(listed)} files")
        entries = [entry for entry in listed if not entry.filename.endswith(("/", "\\"))]
        _check_entries(archive, entries)
        chosen = [entry for entry in entries if _is_wanted(PurePosixPath(entry.filename))]
        suffixes = Counter(PurePosixPath(entry.filename).suffix.lower() for entry in entries)
        if not IMAGE_SUFFIXES & suffixes.keys():
            raise SceneError(
                f"archive {archive} contains no photographs",
                expected=f"images: {' '.join(sorted(IMAGE_SUFFIXES))}",
                found=", ".join(f"{count} files ({suffix})" for suffix, count in suffixes.items()),
                fix="unpack it yourself, and pass the folder of the photographs, or the video",
            )
        require_free_space(folder, sum(entry.file_size for entry in chosen) / 2**20 + 200)
        opened.extractall(folder, chosen)  # stops at the declared size; checks the CRC
        for entry in chosen:
            if (folder / entry.filename).stat().st_size != entry.file_size:
                raise zipfile.BadZipFile(f"{entry.filename} is incomplete")


def _num_listed(archive: Path) -> int:
    """Return the number of files that an archive declares, which zipfile ignores; 65535 if it is large."""
    with archive.open("rb") as stream:
        stream.seek(max(0, archive.stat().st_size - 2**16 - 22))  # the longest comment, and the record itself
        end = stream.read()
    (count,) = struct.unpack_from("<H", end, end.rfind(b"PK\5\6") + 10)
    return count


def _is_wanted(name: PurePosixPath) -> bool:
    """Return whether an entry is an image or may contain poses, and is neither hidden nor added by macOS."""
    if any(part.startswith(".") or part == "__MACOSX" for part in name.parts):
        return False
    return name.suffix.lower() in IMAGE_SUFFIXES | POSE_SUFFIXES or name.name == "metadata"


def _check_entries(archive: Path, entries: list[zipfile.ZipInfo]) -> None:
    fix = "unpack it yourself with a program that you trust, inspect the files, and pass the folder"
    total_gib = sum(entry.file_size for entry in entries) / 2**30
    if len(entries) > MAX_FILES or total_gib > MAX_TOTAL_GIB:
        raise SceneError(
            f"archive {archive} is too large for a set of photographs",
            expected=f"at most {MAX_FILES} files and {MAX_TOTAL_GIB} GiB unpacked",
            found=f"{len(entries)} files and {total_gib:.1f} GiB",
            fix=fix,
        )
    names: set[str] = set()
    for entry in entries:
        if not entry.flag_bits & 0x800:
            with suppress(UnicodeError):  # macOS writes UTF-8, but doesn't set its flag
                entry.filename = entry.filename.encode("cp437").decode()
        entry.filename = entry.filename.replace("\\", "/")  # written on Windows
        name = PurePosixPath(entry.filename)
        faults = {
            "would be unpacked outside the folder": is_outside(entry.filename) or ".." in name.parts,
            "is a link": stat.S_ISLNK(entry.external_attr >> 16),
            "is encrypted": entry.flag_bits & 1,
            "occurs twice": str(name) in names,
        }
        if problem := next((fault for fault, is_found in faults.items() if is_found), ""):
            raise SceneError(f"archive {archive}: entry {entry.filename!r} {problem}", fix=fix)
        names.add(str(name))
