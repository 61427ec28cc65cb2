"""The crop that CLIP sees, on images small enough to check by eye."""

import numpy as np
import pytest

from hilsplat.base.crops import square_crop
from hilsplat.base.errors import EmptyMaskError


def two_colours() -> tuple[np.ndarray, np.ndarray]:
    """A 4 x 8 image, 100 everywhere and 200 in the mask: two pixels side by side at (x 2 and 3, y 1)."""
    image = np.full((4, 8, 3), 100, np.uint8)
    mask = np.zeros((4, 8), bool)
    mask[1, 2:4] = True
    image[mask] = 200
    return image, mask


def test_a_wide_box_is_centred_in_a_square():
    image, mask = two_colours()
    crop = square_crop(image, mask, "black", 0.0, 2)
    # the box is 1 x 2, the square 2 x 2; (2 - 1) // 2 = 0 rows above it, one black row below
    assert crop[..., 0].tolist() == [[200, 200], [0, 0]]


@pytest.mark.parametrize(("background", "outside"), [("black", 0), ("keep", 100), ("dim", 35)])
def test_backgrounds_differ_outside_the_mask_only(background, outside):
    image, mask = two_colours()
    # margin: half of the longer side 2, so 1 px on each side: rows 0..2, columns 1..4
    crop = square_crop(image, mask, background, 0.5, 4)
    assert crop[1, 1:3, 0].tolist() == [200, 200]
    assert crop[0, :, 0].tolist() == [outside] * 4


def test_the_margin_ends_at_the_border_of_the_image():
    image = np.full((4, 4, 3), 50, np.uint8)
    mask = np.ones((4, 4), bool)
    assert (square_crop(image, mask, "black", 1.0, 4) == 50).all()


def test_an_empty_mask_is_refused():
    with pytest.raises(EmptyMaskError, match="without pixels"):
        square_crop(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), bool), "black", 0.0, 2)
