"""Images named by a frame number without leading zeros."""

from collections.abc import Sequence
from pathlib import Path

from hilsplat.base.errors import ImageError, SceneError
from hilsplat.base.images import open_image
from hilsplat.datasets.points.point_files import UNPACK_AGAIN


def by_number(paths: Sequence[Path], prefix: str = "") -> list[tuple[int, Path]]:
    """Sort files by the number in their stem, after a prefix: 2 comes before 10.

    Raises:
        SceneError: a stem is not a number.
    """
    numbered = []
    for path in paths:
        stem = path.stem.removeprefix(prefix)
        if not (stem.isascii() and stem.isdecimal()):
            raise SceneError(
                f"{path} is not named like a frame",
                expected=f"{prefix}<number>{path.suffix}",
                fix="keep other images out of this folder",
            )
        numbered.append((int(stem), path))
    return sorted(numbered)


def size_of_image(image: Path) -> tuple[int, int]:
    """Return height and width of an image file, without decoding it.

    Raises:
        ImageError: it is not an image.
    """
    try:
        with open_image(image) as opened:
            return opened.height, opened.width
    except OSError as error:
        raise ImageError(f"image {image} cannot be read: {error}", fix=UNPACK_AGAIN) from error
