"""Crops for CLIP, on small images."""

import cv2
import numpy as np
import pytest

from hilsplat.segment.crops import crop_to_square, square_crop


def two_colours() -> tuple[np.ndarray, np.ndarray]:
    """A 4 x 8 image, 100 everywhere and 200 in the mask: two pixels side by side at (x 2 and 3, y 1)."""
    image = np.full((4, 8, 3), 100, np.uint8)
    mask = np.zeros((4, 8), bool)
    mask[1, 2:4] = True
    image[mask] = 200
    return image, mask


def test_a_wide_box_is_centred_in_a_square_and_margins_end_at_the_border():
    image, mask = two_colours()
    # the box is 1 x 2, the square 2 x 2; (2 - 1) // 2 = 0 rows above it, one black row below
    assert square_crop(image, mask, "black", 0.0, 2)[..., 0].tolist() == [[200, 200], [0, 0]]
    whole = np.full((4, 4, 3), 50, np.uint8)
    assert (square_crop(whole, np.ones((4, 4), bool), "black", 1.0, 4) == 50).all()


@pytest.mark.parametrize(("background", "outside"), [("black", 0), ("keep", 100), ("dim", 35)])
def test_backgrounds_differ_outside_the_mask_only(background, outside):
    image, mask = two_colours()
    # margin: half of the longer side 2, so 1 px on each side: rows 0..2, columns 1..4
    crop = square_crop(image, mask, background, 0.5, 4)
    assert crop[1, 1:3, 0].tolist() == [200, 200]
    assert crop[0, :, 0].tolist() == [outside] * 4


def published(image: np.ndarray, mask: np.ndarray, size: int) -> np.ndarray:
    """LangSplat's `get_seg_img` and `pad_img`: the box of SAM's masks ends before its last row and column."""
    ys, xs = np.nonzero(mask)
    x, y, w, h = xs.min(), ys.min(), xs.max() - xs.min(), ys.max() - ys.min()
    black = np.where(mask[..., None], image, np.uint8(0))[y : y + h, x : x + w]
    side = max(w, h)
    square = np.zeros((side, side, 3), np.uint8)
    square[(side - h) // 2 : (side - h) // 2 + h, (side - w) // 2 : (side - w) // 2 + w] = black
    return cv2.resize(square, (size, size))


@pytest.mark.parametrize(("height", "width"), [(90, 40), (41, 83), (60, 60)])
def test_crops_as_langsplat_equal_the_published_ones(height, width):
    generator = np.random.default_rng(height)
    image = generator.integers(0, 255, (100, 100, 3), dtype=np.uint8)
    mask = np.zeros((100, 100), bool)
    mask[5 : 5 + height, 7 : 7 + width] = generator.random((height, width)) > 0.3
    ys, xs = np.nonzero(mask)
    box = np.s_[ys.min() : ys.max() + 1, xs.min() : xs.max() + 1]
    found = crop_to_square(image[box], mask[box], "black", 24, as_langsplat=True)
    np.testing.assert_array_equal(found, published(image, mask, 24))
    assert (found != crop_to_square(image[box], mask[box], "black", 24)).any()


def test_a_mask_of_one_column_has_a_crop_as_langsplat():
    column = np.full((5, 1, 3), 9, np.uint8)
    assert crop_to_square(column, np.ones((5, 1), bool), "black", 4, as_langsplat=True).max() > 0
