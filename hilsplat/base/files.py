"""Which files of a folder are images; light enough to import at the start of the workflow."""

from pathlib import Path

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder, by name; other and hidden files are ignored."""
    return sorted(
        path
        for path in Path(folder).iterdir()
        if path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
    )
