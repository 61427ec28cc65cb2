"""Which files of a folder are images; light enough to import at the start of the workflow."""

from collections.abc import Collection
from pathlib import Path

IMAGE_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".avif", ".heic", ".heif", ".hif"}
)
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi"})


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
