"""Unpacking of archives of photographs from untrusted sources."""

import stat
import zipfile
from pathlib import Path, PurePosixPath

from hilsplat.base.artifacts import require_free_space
from hilsplat.base.errors import SceneError
from hilsplat.base.files import IMAGE_SUFFIXES

MAX_FILES = 50_000
MAX_TOTAL_GIB = 20
"""Limits on the contents of an archive; a capture has a few hundred files and rarely a gigabyte."""

POSE_SUFFIXES = frozenset({".json", ".txt", ".bin", ".npy", ".ply"})
"""Suffixes of files that may contain poses or points; Record3D's `metadata` has no suffix."""


def unpack_photographs(archive: Path, folder: Path) -> None:
    """Unpack the images and pose files of a zip archive into an existing, empty folder.

    Every entry is checked before anything is written, and at most the declared sizes are written.

    Raises:
        SceneError: it is not a zip archive, is damaged, encrypted or too large, or contains links or names
            that lead out of the folder.
        DiskSpaceError: there is too little free space.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            entries = [entry for entry in opened.infolist() if not entry.is_dir()]
            _check(archive, entries)
            chosen = [entry for entry in entries if _is_wanted(PurePosixPath(entry.filename))]
            require_free_space(folder, sum(entry.file_size for entry in chosen) / 2**20 + 200)
            for entry in chosen:
                target = folder / PurePosixPath(entry.filename)
                target.parent.mkdir(parents=True, exist_ok=True)
                # zipfile stops at the declared size, and checks the size and the CRC.
                with opened.open(entry) as source, target.open("xb") as sink:
                    while block := source.read(1 << 20):
                        sink.write(block)
    except (zipfile.BadZipFile, NotImplementedError, EOFError, OSError, RuntimeError) as error:
        raise SceneError(
            f"archive {archive} cannot be unpacked: {error}",
            found=f"a file of {archive.stat().st_size} bytes" if archive.is_file() else "no file",
            fix="copy it again, or unpack it yourself and give the folder",
        ) from error


def _is_wanted(name: PurePosixPath) -> bool:
    """Return whether an entry is an image or may contain poses; files that operating systems add are not."""
    if any(part.startswith(".") or part == "__MACOSX" for part in name.parts):
        return False
    return name.suffix.lower() in IMAGE_SUFFIXES | POSE_SUFFIXES or name.name == "metadata"


def _check(archive: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Refuse an archive that is too large or could write outside the folder."""
    fix = "unpack it yourself with a program that you trust, look at it, and give the folder"
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
        name = PurePosixPath(entry.filename)
        if name.is_absolute() or ".." in name.parts or "\\" in entry.filename:
            problem = "leads out of the archive's folder"
        elif stat.S_ISLNK(entry.external_attr >> 16):
            problem = "is a link"
        elif entry.flag_bits & 1:
            problem = "is encrypted"
        elif str(name) in names:
            problem = "is there twice"
        else:
            names.add(str(name))
            continue
        raise SceneError(f"archive {archive}: entry {entry.filename!r} {problem}", fix=fix)
