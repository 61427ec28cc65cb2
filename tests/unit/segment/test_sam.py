"""Sizes, points and logits on their way into and out of SAM."""

import numpy as np
import pytest
import torch

from hilsplat.base.levels import Level
from hilsplat.segment.sam import (
    HEADS,
    Frame,
    SamModel,
    point_grid,
    read_logits,
    resized_size,
    taps,
    valid_low_resolution,
)


def test_heads_run_from_fine_to_coarse():
    assert HEADS == (Level.SUBPART, Level.PART, Level.WHOLE)


@pytest.mark.parametrize(
    ("original", "resized"),
    [
        ((256, 256), (1024, 1024)),
        ((600, 800), (768, 1024)),
        ((1080, 1920), (576, 1024)),
        ((3, 2048), (2, 1024)),
        ((1, 5000), (1, 1024)),
    ],
)
def test_longest_edge_is_kept_and_halves_round_up(original, resized):
    assert resized_size(original, 1024) == resized


def test_grid_points_are_the_centres_of_squares():
    assert point_grid(2).tolist() == [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]


def test_image_is_normalised_then_padded_with_zeros(disc_sam):
    image = np.full((16, 32, 3), 255, dtype=np.uint8)
    pixels, frame = SamModel.load(disc_sam).prepare(image)
    assert frame == Frame((16, 32), (16, 32), (32, 32))
    np.testing.assert_allclose(pixels[0, :, :16], 2.0, rtol=1e-6)  # (255 / 255 - 0.5) / 0.25
    assert (pixels[0, :, 16:] == 0).all()  # padding is zero after normalisation


def test_larger_images_shrink_to_the_longest_edge(disc_sam):
    pixels, frame = SamModel.load(disc_sam).prepare(np.zeros((64, 48, 3), dtype=np.uint8))
    assert frame.resized_hw == (32, 24)
    assert (pixels[0, :, :, :24] == -2).all()
    assert (pixels[0, :, :, 24:] == 0).all()


def test_points_are_scaled_to_the_resized_image(disc_sam):
    model = SamModel.load(disc_sam)
    encoded = model.encode(np.zeros((64, 64, 3), dtype=np.uint8))
    # (32, 16) of 64 px is (16, 8) of the 32-px frame; the nearest cell centres are 15 and 17, 7 and 9
    scores, logits = model.decode(encoded, np.array([[32.0, 16.0]]))
    np.testing.assert_allclose(scores, [[0.9, 0.8, 0.7]], rtol=1e-6)
    for cell in ((3, 7), (3, 8), (4, 7), (4, 8)):
        assert logits[0, 2][cell] == pytest.approx(10 - 2**0.5)
    assert logits[0, 2].max() == pytest.approx(10 - 2**0.5)


SQUARE = Frame((4, 4), (4, 4), (4, 4))


def test_logits_are_rounded_to_eighths_and_clipped():
    logits = np.array([0.0, 0.06, 0.07, -0.3, 99.0, -99.0, 0.1875, 0.3125], dtype=np.float32)
    steps, _, _ = read_logits(logits.reshape(1, 1, 8), 1.0, SQUARE)
    # 0.1875 is 1.5 steps and 0.3125 is 2.5 steps: both go to the even one
    assert steps[0, 0].tolist() == [0, 0, 1, -2, 127, -127, 2, 2]


def test_the_box_holds_what_is_above_zero():
    logits = np.full((2, 4, 6), -1, np.float32)
    logits[0, 1, 2] = logits[0, 2, 4] = 1
    _, _, boxes = read_logits(logits, 1.0, SQUARE)
    assert boxes.tolist() == [[2, 1, 5, 3], [0, 0, 0, 0]]


@pytest.mark.parametrize("length", [1, 7, 48, 90, 500])
def test_taps_equal_two_bilinear_steps_of_torch(length):
    resized = min(64, max(1, round(length * 0.6)))
    first, weights = taps(16, 64, resized, length)
    whole = np.zeros((length, 16))
    for row in range(length):
        whole[row, first[row] : first[row] + weights.shape[1]] = weights[row]
    eye = torch.eye(16)[None]
    padded = torch.nn.functional.interpolate(eye, 64, mode="linear", align_corners=False)[..., :resized]
    if resized != length:
        padded = torch.nn.functional.interpolate(padded, length, mode="linear", align_corners=False)
    np.testing.assert_allclose(whole, padded[0].numpy().T, atol=1e-5)  # torch places pixels in float32


def test_stability_counts_between_the_two_thresholds_and_leaves_out_padding():
    frame = Frame(original_hw=(2, 4), resized_hw=(16, 32), padded_hw=(32, 32))
    logits = np.zeros((1, 4, 4), dtype=np.float32)
    logits[0, 0] = [10, 10, 0, -10]
    logits[0, 1] = [10, 0, 0, -10]
    logits[0, 2:] = 10  # padding
    assert valid_low_resolution((4, 4), frame) == (2, 4)
    assert read_logits(logits, 1.0, frame)[1].tolist() == [pytest.approx(3 / 6)]


def test_a_logit_at_a_threshold_is_not_above_it():
    logits = np.array([1.0, 1.125, -1.0, -0.875], np.float32).reshape(1, 2, 2)
    # above 1: 1.125; above -1: 1, 1.125 and -0.875
    assert read_logits(logits, 1.0, Frame((2, 2), (2, 2), (2, 2)))[1].tolist() == [pytest.approx(1 / 3)]


def test_stability_of_nothing_is_zero():
    assert read_logits(np.full((1, 4, 4), -12.5, np.float32), 1.0, SQUARE)[1].tolist() == [0.0]
