"""Square crops of masked regions: what CLIP sees, in training and at run time alike."""

import cv2
import numpy as np
from jaxtyping import Bool, Int32, UInt8

from hilsplat.base.errors import EmptyMaskError

BACKGROUNDS = ("black", "mean", "keep", "dim")
DIM = 0.35
"""Brightness that `dim` leaves to pixels outside the mask."""


def square_crop(
    image: UInt8[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    background: str,
    context: float,
    size: int,
) -> UInt8[np.ndarray, "size size 3"]:
    """Cut a mask's box out, centre it in a square and resize that (LangSplat's preprocessing).

    The square's side is the longer side of the box (with its margin); what the box does not fill is
    black, or the image's mean colour with `mean`. Shrinking averages areas, enlarging is bilinear.

    Args:
        image: the view.
        mask: region of the view, not empty.
        background: pixels of the box outside the mask: `black`, `mean` colour of the image, `keep`
            them as they are, or `dim` them to 0.35 of their brightness.
        context: margin on each side of the box, as a share of the box's longer side; it ends at the
            image's border.
        size: side of the result, px.

    Raises:
        EmptyMaskError: the mask has no pixel.
    """
    if background not in BACKGROUNDS:
        raise ValueError(f"background {background!r} is none of {', '.join(BACKGROUNDS)}")
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        raise EmptyMaskError("a mask without pixels cannot be cropped", fix="drop empty masks first")
    tight = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.int32)
    x0, y0, x1, y1 = box_with_margin(tight, context, (mask.shape[0], mask.shape[1]))
    fill = background_colour(image, background)
    return crop_to_square(image[y0:y1, x0:x1], mask[y0:y1, x0:x1], background, fill, size)


def box_with_margin(
    box_xyxy: Int32[np.ndarray, " 4"], context: float, size_hw: tuple[int, int]
) -> tuple[int, int, int, int]:
    """A box with a margin on each side, as a share of its longer side, inside the image."""
    x0, y0, x1, y1 = (int(number) for number in box_xyxy)
    margin = round(context * max(y1 - y0, x1 - x0))
    return (
        max(0, x0 - margin),
        max(0, y0 - margin),
        min(size_hw[1], x1 + margin),
        min(size_hw[0], y1 + margin),
    )


def background_colour(image: UInt8[np.ndarray, "H W 3"], background: str) -> UInt8[np.ndarray, " 3"]:
    """The colour of the rest of a square: black, or the image's mean colour with `mean`."""
    if background != "mean":
        return np.zeros(3, np.uint8)
    return (image.reshape(-1, 3).mean(axis=0) + 0.5).astype(np.uint8)


def crop_to_square(
    box: UInt8[np.ndarray, "h w 3"],
    inside: Bool[np.ndarray, "h w"],
    background: str,
    fill: UInt8[np.ndarray, " 3"],
    size: int,
) -> UInt8[np.ndarray, "size size 3"]:
    """The second half of `square_crop`, from the part of the image inside the box."""
    if background == "dim":
        box = np.where(inside[..., None], box, (box * DIM + 0.5).astype(np.uint8))
    elif background != "keep":
        box = np.where(inside[..., None], box, fill)
    height, width = box.shape[:2]
    side = max(height, width)
    square = np.empty((side, side, 3), np.uint8)
    square[:] = fill
    top, left = (side - height) // 2, (side - width) // 2
    square[top : top + height, left : left + width] = box
    method = cv2.INTER_AREA if side > size else cv2.INTER_LINEAR
    return cv2.resize(square, (size, size), interpolation=method)
