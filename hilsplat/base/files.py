"""Which files of a folder are images; light enough for the workflow's start-up."""

from pathlib import Path

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder, by name; other files and hidden ones are passed over."""
    return sorted(
        path
        for path in Path(folder).iterdir()
        if path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
    )
