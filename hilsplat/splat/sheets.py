"""Small pictures side by side on one sheet."""

import numpy as np
from jaxtyping import UInt8

MAX_SIDE_PX = 320
"""Longer side of a picture on a sheet."""
GAP_PX = 4


def contact_sheet(
    pictures: list[UInt8[np.ndarray, "_ _ 3"]], columns: int, max_side_px: int = MAX_SIDE_PX
) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures on a white sheet, row by row, shrunk by whole factors (averages) to at most `max_side_px`."""
    cells = [_shrunk(picture, -(-max(picture.shape[:2]) // max_side_px)) for picture in pictures]
    height, width = (max(cell.shape[axis] for cell in cells) + GAP_PX for axis in (0, 1))
    rows = -(-len(cells) // columns)
    sheet = np.full((rows * height, min(columns, len(cells)) * width, 3), 255, np.uint8)
    for k, cell in enumerate(cells):
        y, x = (k // columns) * height, (k % columns) * width
        sheet[y : y + cell.shape[0], x : x + cell.shape[1]] = cell
    return sheet


def _shrunk(picture: UInt8[np.ndarray, "_ _ 3"], factor: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Averages of blocks of factor x factor pixels; what is left at the border is cut off."""
    if factor <= 1:
        return picture
    height, width = (side // factor for side in picture.shape[:2])
    blocks = picture[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)
