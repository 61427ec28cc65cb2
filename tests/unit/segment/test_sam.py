"""Conversion of images, points and logits for SAM, and its thresholds."""

import numpy as np
import pytest

from hilsplat.embed.model_check import check_model
from hilsplat.segment.sam import Frame, SamModel, read_logits
from hilsplat.segment.thresholds import REAL_SAM, Thresholds
from hilsplat.settings import MasksSettings
from models.training.export import OWN_THRESHOLDS


def test_longest_edge_is_kept_and_halves_round_up(disc_sam):
    model = SamModel.load(disc_sam)
    model.longest_edge = 1024
    found = [model.frame(size).resized_hw for size in ((600, 800), (3, 2048), (1, 5000))]
    assert found == [(768, 1024), (2, 1024), (1, 1024)]


@pytest.mark.parametrize(
    ("original_hw", "resized_hw", "value", "expected"),
    [((16, 32), (16, 32), 255, 2.0), ((64, 48), (32, 24), 0, -2.0)],  # (255 / 255 - 0.5) / 0.25
)
def test_images_are_shrunk_and_normalised_then_padded_with_zeros(
    disc_sam, original_hw, resized_hw, value, expected
):
    pixels, frame = SamModel.load(disc_sam).prepare(np.full((*original_hw, 3), value, np.uint8))
    assert frame == Frame(original_hw, resized_hw, (32, 32))
    np.testing.assert_allclose(pixels[0, :, : resized_hw[0], : resized_hw[1]], expected, rtol=1e-6)
    assert (pixels[0, :, resized_hw[0] :] == 0).all()
    assert (pixels[0, :, :, resized_hw[1] :] == 0).all()


def test_points_are_scaled_to_the_resized_image(disc_sam):
    model = SamModel.load(disc_sam)
    # (32, 16) of 64 px is (16, 8) of the 32-px frame; the nearest cell centres are 15 and 17, 7 and 9
    scores, logits = model.decode(model.encode(np.zeros((64, 64, 3), np.uint8)), np.array([[32.0, 16.0]]))
    np.testing.assert_allclose(scores, [[0.9, 0.8, 0.7]], rtol=1e-6)
    np.testing.assert_allclose(logits[0, 2, 3:5, 7:9], 10 - 2**0.5, rtol=1e-6)
    assert logits[0, 2].max() == pytest.approx(10 - 2**0.5)


def test_logits_are_rounded_to_eighths_and_clipped_and_the_positive_ones_have_boxes():
    logits = np.full((2, 2, 6), -99, np.float32)
    logits[0] = [[0, 0.06, 0.07, -0.3, 99, -99], [-1, -1, -1, 0.1875, -1, -1]]
    steps, _, boxes = read_logits(logits, 1.0, Frame((4, 4), (4, 4), (4, 4)))
    assert steps[0].tolist() == [[0, 0, 1, -2, 127, -127], [-8, -8, -8, 2, -8, -8]]  # 1.5 steps: the even one
    assert boxes.tolist() == [[2, 0, 5, 2], [0, 0, 0, 0]]


def test_thresholds_are_the_settings_else_the_models_else_langsplats(own_sam, project):
    tiny = project / "models/sam-tiny"
    assert SamModel.load(tiny).thresholds(MasksSettings()) == OWN_THRESHOLDS == Thresholds(0.35, 0.5, 0.0, 16)
    assert "thresholds predicted IoU 0.35, stability 0.5, score 0.0" in check_model(tiny)
    chosen = MasksSettings(stability_min=0.9, points_per_batch=3)
    assert SamModel.load(own_sam).thresholds(chosen) == Thresholds(0.35, 0.9, 0.0, 3)
    (own_sam / "config.json").write_text('{"model_type": "sam"}')
    assert SamModel.load(own_sam).thresholds(MasksSettings()) == REAL_SAM == Thresholds(0.7, 0.85, 0.7, 8)


@pytest.mark.parametrize(
    ("rows", "resized_hw", "expected"),
    [
        # above 1: 1.125; above -1: 1, 1.125 and -0.875
        ([[1, 1.125], [-1, -0.875]], (32, 32), 1 / 3),
        # the lower half is padding
        ([[10, 10, 0, -10], [10, 0, 0, -10], [10] * 4, [10] * 4], (16, 32), 3 / 6),
        ([[-12.5] * 4] * 4, (32, 32), 0),
    ],
)
def test_stability_counts_pixels_of_the_image_above_both_thresholds(rows, resized_hw, expected):
    _, stability, _ = read_logits(np.array([rows], np.float32), 1.0, Frame((2, 4), resized_hw, (32, 32)))
    assert stability.tolist() == [pytest.approx(expected)]
