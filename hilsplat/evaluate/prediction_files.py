"""Readers for predictions of other programs: masks per view and text, classes and instances of points."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64

from hilsplat.base.artifacts import read_npz
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.images import open_image
from hilsplat.base.levels import LEVELS

FOREGROUND = 128
"""Grey values above this are foreground, as in Gaussian Grouping's script."""

LEVEL_FOLDERS = tuple(level.label for level in LEVELS)


def read_view_masks(folder: Path, view: str) -> dict[tuple[str, str], Bool[np.ndarray, "h w"]]:
    """Return the masks of one view by (level, text); the level is "" for masks without one.

    Files are `<view>/<text>.png`, `<view>/<level>/<text>.png` (level whole, part or subpart), or `<view>.npz`
    with an array per text, "<text>" or "<level>/<text>". A view without predictions has an empty folder.

    Args:
        view: view name, such as "frame_00041.png"; folders and files are named without the suffix.

    Raises:
        ArtifactError: the view has neither folder nor file, or both, or one of them cannot be used.
    """
    stem = Path(view).stem
    place, packed = Path(folder) / stem, Path(folder) / f"{stem}.npz"
    if packed.is_file() and place.is_dir():
        raise ArtifactError(
            f"view {stem} has predictions twice",
            expected=f"{packed.name} or {place.name}/",
            found="both",
            fix="remove the one that you don't mean",
        )
    if packed.is_file():
        return {_key(name): _as_mask(array, f"{packed}: {name}") for name, array in read_npz(packed).items()}
    if not place.is_dir():
        raise ArtifactError(
            f"view {stem} has no predictions",
            expected=f"{place}/<text>.png, or {packed.name}",
            fix="write them; an empty folder says that nothing was found there",
        )
    masks = {}
    for path in sorted(place.rglob("*.png")):
        masks[_key(path.relative_to(place).with_suffix("").as_posix())] = _read_png(path)
    return masks


def read_point_classes(path: Path, num_points: int) -> Int64[np.ndarray, " P"]:
    """Read class ids of points from ScanNet's text format, one integer per line; 0 means none.

    Raises:
        ArtifactError: the file is missing or malformed.
        MisalignedArtifactError: the number of points differs.
    """
    words = _text(path).split()
    try:
        values = np.array(words, dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise ArtifactError(
            f"{path} does not hold one whole number per line",
            found=str(error),
            fix="write class ids, 0 for none",
        ) from error
    if len(values) != num_points:
        raise MisalignedArtifactError(
            f"{path} does not belong to the labelled points",
            expected=f"{num_points} lines, one per point in the order of the labels",
            found=len(values),
            fix="predict on the points of the ground truth",
        )
    return values


def read_point_instances(
    path: Path, num_points: int
) -> tuple[Bool[np.ndarray, "M P"], Int64[np.ndarray, " M"], Float64[np.ndarray, " M"]]:
    """Read masks, class ids and confidences in ScanNet's format: lines of mask file, class id and confidence.

    A mask file has one integer per point; non-zero points belong to the instance. Its path is relative to the
    folder of `path`.

    Raises:
        ArtifactError: a file is missing or malformed.
        MisalignedArtifactError: the number of points in a mask differs.
    """
    path = Path(path)
    masks, classes, confidences = [], [], []
    for number, line in enumerate(_text(path).splitlines(), 1):
        if not line.strip():
            continue
        try:
            name, class_id, confidence = line.rsplit(maxsplit=2)
            classes.append(int(class_id))
            confidences.append(float(confidence))
        except ValueError as error:
            raise ArtifactError(
                f"line {number} of {path} is not an instance",
                expected="<mask file> <class id> <confidence>",
                found=line,
                fix="write one line per predicted instance, in ScanNet's format",
            ) from error
        masks.append(read_point_classes(path.parent / name, num_points) != 0)
    stacked = np.array(masks, dtype=bool).reshape(len(masks), num_points)
    return stacked, np.array(classes, dtype=np.int64), np.array(confidences, dtype=np.float64)


def _key(name: str) -> tuple[str, str]:
    first, _, rest = name.partition("/")
    return (first, rest) if rest and first in LEVEL_FOLDERS else ("", name)


def _read_png(path: Path) -> Bool[np.ndarray, "h w"]:
    try:
        with open_image(path) as image:
            grey = np.asarray(image.convert("L"))
    except (OSError, SyntaxError) as error:
        raise ArtifactError(f"mask {path} cannot be read: {error}", fix="write it again") from error
    return _as_mask(grey, str(path))


def _as_mask(array: np.ndarray, where: str) -> Bool[np.ndarray, "h w"]:
    if array.ndim != 2:
        raise ArtifactError(
            f"mask {where} is no image",
            expected="height x width",
            found=" x ".join(map(str, array.shape)),
        )
    if array.dtype == bool:
        return array
    mask = array > FOREGROUND
    if not mask.any() and array.any():
        raise ArtifactError(
            f"mask {where} has values, but none is foreground",
            expected=f"0 and 255: what is above {FOREGROUND} is foreground",
            found=f"values up to {array.max()}",
            fix="multiply the mask by 255, or store it as bool in a .npz",
        )
    return mask


def _text(path: Path) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ArtifactError(f"{path} cannot be read: {error}", fix="write it as text") from error
