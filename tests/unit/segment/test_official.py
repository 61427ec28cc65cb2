"""`generator: official` is SAM's automatic generator and LangSplat's suppression as published."""

import numpy as np
import pytest

from benchmarks.canned_sam import CannedSam, NetworkClock
from hilsplat.segment.generate import clean_masks
from hilsplat.segment.sam import HEADS
from hilsplat.segment.suppression import distinct_boxes, last_inside, suppress_boxes
from hilsplat.settings import MasksSettings
from tests.unit.segment import official
from tests.unit.segment.handmade import generate, pack


@pytest.mark.parametrize(("crop_layers", "points_per_side"), [(0, 9), (1, 5)])
def test_the_masks_are_those_of_the_published_generator(crop_layers, points_per_side):
    canned = CannedSam(NetworkClock(), seed=3)
    image = np.zeros((180, 240, 3), np.uint8)
    chosen = MasksSettings(
        generator="official",
        crop_layers=crop_layers,
        points_per_side=points_per_side,
        stability_min=0.6,
        nms_score=0.4,
        min_area_px=40,
    )
    masks = generate(canned, chosen, image)
    for (expected, scores), level in zip(official.generate(image, canned, chosen), HEADS, strict=True):
        rows = masks.rows_of(level)
        found = masks.dense(rows)
        assert len(found) == len(expected) > 5
        apart = (found[:, None] != expected[None]).mean(axis=(2, 3))
        nearest = apart.argmin(axis=1)
        assert len(set(nearest)) == len(expected)
        assert apart.min(axis=1).max() < 1e-4  # the order of sums may decide on the border itself
        np.testing.assert_array_equal(masks.predicted_iou[rows], scores[nearest].astype(np.float32))


@pytest.mark.parametrize(
    ("boxes", "score", "iou_max", "officially", "ours"),
    [
        # 4 and 3 columns: IoU 3 / 4; ending at the last one inside, 2 / 3
        ([[0, 0, 4, 9], [0, 0, 3, 9]], [0.9, 0.8], 0.7, [0, 1], [0]),
        # equal scores: the earlier box officially, the larger one here
        ([[0, 0, 10, 9], [0, 0, 10, 10]], [1.0, 1.0], 0.5, [0], [1]),
    ],
)
def test_ends_of_boxes_and_ties_differ_from_official_ones(boxes, score, iou_max, officially, ours):
    boxes, score = np.array(boxes), np.array(score)
    assert distinct_boxes(last_inside(boxes), score, iou_max).tolist() == officially
    assert suppress_boxes(boxes, score, iou_max).tolist() == ours


def test_scores_above_one_do_not_outweigh_the_first_rank():
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 9]])
    assert suppress_boxes(boxes, np.array([2.5, 0.1]), 0.5, np.array([0.0, 1.0])).tolist() == [1]


def test_a_small_mask_can_be_kept_and_counts_as_changed():
    mask = np.zeros((1, 8, 8), bool)
    mask[0, 2:4, 2:4] = True
    masks, changed = clean_masks(pack(mask), 10, keep_small=True)
    np.testing.assert_array_equal(masks.dense(), mask)
    assert changed.tolist() == [True]
