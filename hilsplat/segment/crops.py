"""Square crops of masked regions, the input of CLIP in training and at run time."""

import numpy as np
from jaxtyping import Bool, UInt8

DIM = 0.35  # brightness factor of pixels outside the mask for the background `dim`


def square_crop(
    image: UInt8[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    background: str,
    context: float,
    size: int,
) -> UInt8[np.ndarray, "size size 3"]:
    """Crop the box of a non-empty mask with a margin, and make it square (`crop_to_square`).

    `context` is the margin on each side as a share of the box's longer side, clipped at the image's border.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    (y0, y1), (x0, x1) = ((int(inside[0]), int(inside[-1]) + 1) for inside in (rows, columns))
    margin = round(context * max(y1 - y0, x1 - x0))
    window = np.s_[max(0, y0 - margin) : y1 + margin, max(0, x0 - margin) : x1 + margin]
    return crop_to_square(image[window], mask[window], background, size)


def crop_to_square(
    box: UInt8[np.ndarray, "h w 3"],
    inside: Bool[np.ndarray, "h w"],
    background: str,
    size: int,
    as_langsplat: bool = False,
) -> UInt8[np.ndarray, "size size 3"]:
    """Centre a mask's box in a black square and resize it.

    The side of the square is the longer side of the box. Shrinking averages areas; enlarging is bilinear.

    Args:
        box, inside: image and mask, cropped to the mask's box.
        background: pixels outside the mask: `black`, `keep` (unchanged), or `dim` (0.35 of their brightness).
        as_langsplat: follow LangSplat's preprocessing: omit the last row and column of the box (but keep at
            least one), and use bilinear resizing for shrinking, too.
    """
    if background != "keep":
        outside = (box * DIM + 0.5).astype(np.uint8) if background == "dim" else np.uint8(0)
        box = np.where(inside[..., None], box, outside)
    if as_langsplat:
        box = box[: max(1, box.shape[0] - 1), : max(1, box.shape[1] - 1)]
    height, width = box.shape[:2]
    side = max(height, width)
    square = np.zeros((side, side, 3), np.uint8)
    top, left = (side - height) // 2, (side - width) // 2
    square[top : top + height, left : left + width] = box
    import cv2  # slow import

    method = cv2.INTER_AREA if side > size and not as_langsplat else cv2.INTER_LINEAR
    return cv2.resize(square, (size, size), interpolation=method)
