"""Rules for names in paths, image lists of folders, and paths in the installed project."""

import os
import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path, PureWindowsPath

from hilsplat.base.errors import ArtifactError, HilsplatError

IMAGE_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".tif", ".tiff", ".bmp", ".webp", ".avif"}
    | {".heic", ".heif", ".hif"}
)
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi"})

_PACKAGE = Path(__file__).resolve().parents[1]
INSTALLED = _PACKAGE / "_project" if (_PACKAGE / "_project").is_dir() else _PACKAGE.parent
"""Folder of the installed project: Snakefile, rules, config, models. In a wheel, it is inside the package."""

MAX_NAME = 100
"""Maximum length of data set, scene, group and variant names, which are part of paths and commands."""

NAME_RULE = "letters a-z A-Z, digits, dot, dash and underscore, beginning with a letter or digit"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def project_path(path: str | Path) -> Path:
    """Return the path in the working folder if it exists there, else in the installed project.

    A path that exists in neither is returned unchanged, so that messages show what the user wrote.
    """
    installed = INSTALLED / path
    return installed if not Path(path).exists() and installed.exists() else Path(path)


def is_outside(name: str) -> bool:
    """Return whether a path in a file is absolute, also on Windows, or leads out of its folder."""
    depth = 0
    for part in name.replace("\\", "/").split("/"):
        depth += {"..": -1, ".": 0, "": 0}.get(part, 1)
        if depth < 0:
            return True
    return bool(PureWindowsPath(name).anchor)


def regular(path: Path) -> Path:
    """Return a path; raise HilsplatError for a pipe or device, because reading it could wait for ever."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise HilsplatError(
            f"{path} is a pipe or device", expected="a file", fix="save its content as a file"
        )
    return path


def list_images(folder: Path) -> list[Path]:
    return list_files(folder, IMAGE_SUFFIXES)


def list_files(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Return the files in a folder with one of these suffixes, sorted; skip hidden files."""
    return sorted(
        path
        for path in Path(folder).iterdir()
        if path.suffix.lower() in suffixes
        and not path.name.startswith(".")
        and (path.is_file() or (path.is_symlink() and not path.exists()))  # reading a broken link fails later
    )


FILES_OF_DESKTOPS = (".DS_Store", "Thumbs.db", "desktop.ini")
"""Names of files that desktops write into any folder that a user looks at."""


def list_masks(folder: Path, pattern: str = "*") -> list[Path]:
    """Return the images in a folder, one for each name without suffix, sorted; skip hidden files and folders.

    Raises:
        ArtifactError: a file has another format, or two files differ only in their suffix.
    """
    files = sorted(path for path in folder.glob(pattern) if not path.is_dir())
    masks: dict[Path, Path] = {}
    for path in files:
        name = path.relative_to(folder)
        if any(part.startswith(".") for part in name.parts) or path.name in FILES_OF_DESKTOPS:
            continue
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            expected = f"images: {' '.join(sorted(IMAGE_SUFFIXES))}"
            raise ArtifactError(f"{path} is not a mask", expected=expected, fix="convert or remove it")
        if other := masks.get(name.with_suffix("")):
            raise ArtifactError(f"{other} and {path} are two masks with one name", fix="remove one of them")
        masks[name.with_suffix("")] = path
    return list(masks.values())


def files_below(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and its subfolders, also hidden ones.

    If another command deletes some at the same time, `Path.rglob` would raise an error.
    """
    for parent, _, names in os.walk(folder):
        yield from (Path(parent, name) for name in names)


def stats_of(paths: Iterable[Path]) -> dict[Path, os.stat_result]:
    """Return the sizes and times of files, without those that another command has just deleted."""
    stats = {}
    for path in paths:
        with suppress(FileNotFoundError):
            stats[path] = path.stat()
    return stats


def name_problem(name: str) -> str | None:
    """Return the problem with a name, or None if the name is valid."""
    if not name:
        return "it is empty"
    if len(name) > MAX_NAME:
        return f"it is longer than {MAX_NAME} characters"
    if ".." in name:
        return 'it contains ".."'
    if NAME.fullmatch(name):
        return None
    if not re.fullmatch("[A-Za-z0-9]", name[0]):
        return f"it begins with {name[0]!r}"
    bad = sorted({letter for letter in name if not re.fullmatch("[A-Za-z0-9._-]", letter)})
    return f"it contains {', '.join(repr(letter) for letter in bad)}"
