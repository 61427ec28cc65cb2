"""Find files: images of a folder, and files of the installed project."""

from collections.abc import Collection
from pathlib import Path

IMAGE_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".avif", ".heic", ".heif", ".hif"}
)
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi"})

INSTALLED = Path(__file__).resolve().parents[2]
"""Folder of the installed project: Snakefile, rules, config, models."""


def project_path(path: str | Path) -> Path:
    """Return a path of the project: in the working folder if it exists there, else in the installed project.

    A path that exists in neither is returned unchanged, so that messages name what the user wrote.
    """
    installed = INSTALLED / path
    return installed if not Path(path).exists() and installed.exists() else Path(path)


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder, by name; other and hidden files are ignored."""
    return _with_suffix(folder, IMAGE_SUFFIXES)


def list_videos(folder: Path) -> list[Path]:
    """Video files of a folder, by name; other and hidden files are ignored."""
    return _with_suffix(folder, VIDEO_SUFFIXES)


def _with_suffix(folder: Path, suffixes: Collection[str]) -> list[Path]:
    return sorted(
        path
        for path in Path(folder).iterdir()
        if path.is_file() and path.suffix.lower() in suffixes and not path.name.startswith(".")
    )
