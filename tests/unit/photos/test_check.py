"""Likely problems are reported before the run; good photographs raise no doubt."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from hilsplat.photos.check import MAX_PAIRS, blur, checked_photo, matched_rows, photo_doubts
from tests.unit.scene.test_poses import plane_views

SIZE = 360


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """Twelve pictures of a textured corner by a camera on an arc of 44 degrees."""
    folder = tmp_path_factory.mktemp("moving") / "views"
    names = plane_views(folder, views=12, size=SIZE, step_deg=4).names
    return [np.asarray(Image.open(folder / name).convert("L")) for name in names]


def turning(picture, steps_deg):
    """Pictures of a camera with a narrower lens that turns in place before a picture."""
    focal = 1.2 * SIZE
    wide = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    narrow = wide * [[1.8, 1, 1], [1, 1.8, 1], [1, 1, 1]]
    pictures = []
    for angle in steps_deg:
        rotation = cv2.Rodrigues(np.radians([angle / 5, angle, angle / 9]))[0]
        homography = narrow @ rotation @ np.linalg.inv(wide)
        turned = cv2.warpPerspective(picture, homography, (SIZE, SIZE), flags=cv2.INTER_CUBIC)
        noise = np.random.default_rng(0).normal(0, 2, turned.shape)
        pictures.append(np.clip(turned + noise, 0, 255).astype(np.uint8))
    return pictures


def checked(pictures):
    matched = matched_rows(len(pictures))
    colours = [cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB) for picture in pictures]
    return [
        checked_photo(f"{row}.jpg", pixels, None, is_matched=row in matched)
        for row, pixels in enumerate(colours)
    ]


def doubts_of(pictures, have_poses=False):
    return photo_doubts(checked(pictures), have_poses=have_poses)


@pytest.fixture(scope="module")
def photos(moving):
    return checked(moving)


@pytest.mark.parametrize("number", [0, 1, 2, 61, 62, 2000])
def test_all_neighbours_of_a_small_set_and_some_of_a_large_one_are_compared(number):
    rows = matched_rows(number)
    assert rows <= set(range(number)) and len(rows) <= 2 * MAX_PAIRS
    assert sum(row + 1 in rows for row in rows) >= min(number - 1, MAX_PAIRS)
    assert number > 61 or number < 2 or rows == set(range(number))


def test_a_moving_camera_raises_no_doubt_unless_photographs_are_few(photos):
    assert photo_doubts(photos, have_poses=False) == []
    (doubt,) = photo_doubts(photos[:9], have_poses=False)
    assert doubt.startswith("only 9 photographs: take 20 or more")


def test_a_camera_that_turns_in_place_is_reported_with_its_evidence(moving):
    pictures = turning(moving[0], np.linspace(-8, 8, 10))
    (doubt,) = doubts_of(pictures)
    assert "turn in place: rotation alone explains 9 of the 9 pairs" in doubt
    assert "walk around the scene" in doubt
    assert doubts_of(pictures, have_poses=True) == []
    assert doubts_of([*turning(moving[0], np.linspace(-4, 4, 5)), *moving]) == []


def test_faulty_photographs_are_named(moving, photos):
    def with_third(change):
        third = replace(checked([change(moving[2])])[0], name="2.jpg")
        return photo_doubts([*photos[:2], third, *photos[3:]], have_poses=False)

    (blurred,) = with_third(lambda picture: cv2.GaussianBlur(picture, (0, 0), 5))
    assert blurred.startswith("1 of 12 photographs (2.jpg) is blurred")
    (dark,) = with_third(lambda picture: (picture * 0.15).astype(np.uint8))
    assert dark.startswith("1 of 12 photographs (2.jpg) is too dark")
    (white,) = with_third(lambda picture: np.clip(picture * 4.0, 0, 255).astype(np.uint8))
    assert white.startswith("1 of 12 photographs (2.jpg) is more than half white")
    (wide, *_) = with_third(lambda picture: picture[: len(picture) // 2])
    assert wide.startswith("1 of 12 photographs (2.jpg) is exactly twice as wide as high: cut 360-")


@pytest.mark.parametrize("name", ["1.mask.png", "1_MASK.jpg", "1.jpg.png", "1.jpg.mask.png", "1-edited.jpg"])
def test_masks_and_copies_of_other_photographs_are_named(photos, name):
    named = [*photos[:2], replace(photos[2], name=name), *photos[3:]]
    (doubt,) = photo_doubts(named, have_poses=False)
    assert doubt.startswith(f"1 of 12 photographs ({name}) is named like masks or copies of others")
    assert photo_doubts(named[2:], have_poses=False) == []


def test_photographs_from_one_place_are_named(moving):
    shifted = [np.roll(picture, 1, axis=1) for picture in moving]
    pictures = [picture for pair in zip(moving, shifted, strict=True) for picture in pair]
    (doubt,) = doubts_of(pictures)
    listed = "1.jpg, 3.jpg, 5.jpg, 7.jpg, 9.jpg and 7 more"
    assert doubt.startswith(f"12 of 24 photographs ({listed}) are nearly identical")


def test_different_sizes_and_lenses_are_reported_but_not_a_turned_camera(photos):
    def with_half(first, second):
        half = len(photos) // 2
        return photo_doubts(
            [replace(photo, **(first if row < half else second)) for row, photo in enumerate(photos)],
            have_poses=False,
        )

    assert with_half({"size_hw": (480, 640)}, {"size_hw": (640, 480)}) == []
    (sizes,) = with_half({"size_hw": (480, 640)}, {"size_hw": (600, 800)})
    assert sizes.startswith("the photographs have 2 sizes (800 x 600, 640 x 480)")
    (lenses,) = with_half({"focal_px": 500.0}, {"focal_px": 900.0})
    assert lenses.startswith("the focal lengths range from 500 to 900 px")
    assert with_half({"focal_px": 500.0}, {"focal_px": 510.0}) == []


def test_flat_photographs_do_not_break_the_check():
    assert any("blurred" in doubt for doubt in doubts_of([np.full((60, 80), 128, np.uint8)] * 12))


def test_blur_matches_its_definition():
    """A box of 11 px spreads a step of 1 over 11 steps of 1/11, so that 10/11 of it are lost: 1/11 remains. A
    blurred picture has little to lose."""
    picture = np.zeros((30, 30), np.uint8)
    picture[15:, 15:] = 110
    sharp = blur(picture)
    assert sharp == pytest.approx(1 / 11, abs=0.02)
    assert blur(cv2.GaussianBlur(picture, (0, 0), 4)) > 0.5
