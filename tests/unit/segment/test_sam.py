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
    quantise,
    resized_size,
    restore,
    stability_of,
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


def test_logits_are_rounded_to_eighths_and_clipped():
    logits = np.array([0.0, 0.06, 0.07, -0.3, 99.0, -99.0], dtype=np.float32)
    assert quantise(logits).tolist() == [0, 0, 1, -2, 127, -127]


def test_restored_mask_equals_two_bilinear_steps_of_torch():
    generator = np.random.default_rng(0)
    logits = generator.integers(-60, 60, (16, 16)).astype(np.int8)
    frame = Frame(original_hw=(90, 120), resized_hw=(48, 64), padded_hw=(64, 64))
    steps = torch.from_numpy(logits.astype(np.float32))[None, None]
    padded = torch.nn.functional.interpolate(steps, (64, 64), mode="bilinear", align_corners=False)
    full = torch.nn.functional.interpolate(
        padded[..., :48, :], (90, 120), mode="bilinear", align_corners=False
    )
    expected = full[0, 0].numpy()
    found = restore(logits, frame)
    clear = np.abs(expected) > 1e-3  # rounding may decide on the border itself
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(found[clear], expected[clear] > 0)


def test_stability_counts_between_the_two_thresholds_and_leaves_out_padding():
    frame = Frame(original_hw=(2, 4), resized_hw=(16, 32), padded_hw=(32, 32))
    logits = np.zeros((1, 4, 4), dtype=np.int8)
    logits[0, 0] = [80, 80, 0, -80]  # 10, 10, 0, -10 in logits
    logits[0, 1] = [80, 0, 0, -80]
    logits[0, 2:] = 80  # padding
    assert valid_low_resolution((4, 4), frame) == (2, 4)
    assert stability_of(logits, 1.0, frame).tolist() == [pytest.approx(3 / 6)]


def test_stability_of_nothing_is_zero():
    frame = Frame((4, 4), (4, 4), (4, 4))
    assert stability_of(np.full((1, 4, 4), -100, np.int8), 1.0, frame).tolist() == [0.0]
