"""`generator: official` is SAM's automatic generator and LangSplat's suppression as published."""

import numpy as np
import pytest

from benchmarks.canned_sam import CannedSam, NetworkClock
from hilsplat.segment.candidates import decode_candidates, positive_boxes
from hilsplat.segment.generate import clean_masks, masks_from_candidates
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import HEADS, Frame, SamModel, full_stability, read_logits
from hilsplat.segment.suppression import suppress_boxes, suppress_boxes_officially
from hilsplat.settings import MasksSettings
from tests.unit.segment import official
from tests.unit.segment.plain import smooth_logits


def settings(**changes) -> MasksSettings:
    chosen = {
        "points_per_side": 9 - 4 * changes.get("crop_layers", 1),
        "stability_min": 0.6,
        "nms_score": 0.4,
        "min_area_px": 40,
        "crop_layers": 1,
    }
    return MasksSettings(**chosen | changes)


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    return np.zeros((180, 240, 3), np.uint8)


@pytest.fixture(scope="module")
def canned() -> SamModel:
    return CannedSam(NetworkClock(), seed=3)


@pytest.mark.parametrize("crop_layers", [0, 1])
def test_the_masks_are_those_of_the_published_generator(canned, image, crop_layers):
    chosen = settings(generator="official", crop_layers=crop_layers)
    masks = masks_from_candidates(decode_candidates(image, canned, chosen), image.shape[:2], canned, chosen)
    for (expected, scores), level in zip(official.generate(image, canned, chosen), HEADS, strict=True):
        rows = masks.rows_of(level)
        found = masks.dense(rows)
        assert len(found) == len(expected) > 5
        apart = (found[:, None] != expected[None]).mean(axis=(2, 3))
        nearest = apart.argmin(axis=1)
        assert len(set(nearest)) == len(expected)
        assert apart.min(axis=1).max() < 1e-4  # the order of sums may decide on the border itself
        np.testing.assert_array_equal(masks.predicted_iou[rows], scores[nearest].astype(np.float32))


def test_our_generator_differs_so_the_switch_has_an_effect(canned, image):
    by = {
        name: masks_from_candidates(
            decode_candidates(image, canned, settings(generator=name)),
            image.shape[:2],
            canned,
            settings(generator=name),
        )
        for name in ("hilsplat", "official")
    }
    assert len(by["hilsplat"]) != len(by["official"])


@pytest.mark.parametrize("original_hw", [(64, 64), (90, 160), (33, 20)])
def test_full_stability_counts_pixels_of_the_enlarged_logits(original_hw):
    logits = smooth_logits(20, 32, seed=1) / 8
    side = max(original_hw)
    frame = Frame(
        original_hw, (round(128 * original_hw[0] / side), round(128 * original_hw[1] / side)), (128, 128)
    )
    large = official.full_size(logits, frame)
    small, wide = (large > 1).sum(axis=(1, 2)), (large > -1).sum(axis=(1, 2))
    found = full_stability(logits, 1.0, frame)
    np.testing.assert_allclose(found, small / np.maximum(wide, 1), atol=3 / wide.min())
    assert np.abs(found - read_logits(logits, 1.0, frame)[1]).max() > 0.003


def test_boxes_that_end_inside_decide_otherwise():
    # 4 and 3 columns: IoU 3 / 4; ending at the last one inside, 2 / 3
    boxes = np.array([[0, 0, 4, 9], [0, 0, 3, 9]])
    score = np.array([0.9, 0.8])
    assert suppress_boxes(boxes, score, 0.7).tolist() == [0]
    assert suppress_boxes_officially(boxes, score, 0.7).tolist() == [0, 1]


def test_scores_above_one_do_not_outweigh_the_first_rank():
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 9]])
    assert suppress_boxes(boxes, np.array([2.5, 0.1]), 0.5, np.array([0.0, 1.0])).tolist() == [1]


def test_equal_scores_go_by_row_officially_and_by_area_here():
    boxes, score = np.array([[0, 0, 10, 9], [0, 0, 10, 10]]), np.ones(2)
    assert suppress_boxes_officially(boxes, score, 0.5).tolist() == [0]
    assert suppress_boxes(boxes, score, 0.5).tolist() == [1]


def test_a_mask_that_is_small_as_a_whole_stays_and_counts_as_changed():
    mask = np.zeros((1, 8, 8), bool)
    mask[0, 2:4, 2:4] = True
    one = np.ones(1, np.float32)
    masks, changed = clean_masks(HierarchicalMasks.from_dense(mask, np.ones(1, np.uint8), one, one), 10, True)
    np.testing.assert_array_equal(masks.dense(), mask)
    assert changed.tolist() == [True]


def test_positive_boxes_by_hand():
    logits = np.full((2, 4, 6), -1, np.float32)
    logits[0, 1, 2] = logits[0, 2, 4] = 0.01
    assert positive_boxes(logits).tolist() == [[2, 1, 5, 3], [0, 0, 0, 0]]
