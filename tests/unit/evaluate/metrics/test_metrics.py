"""Metrics of masks, rules for maps and hierarchical consistency, on examples worked by hand."""

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilsplat.base.levels import LEVELS
from hilsplat.evaluate.metrics import masks
from hilsplat.evaluate.metrics import relevancy_rule as rules
from hilsplat.evaluate.metrics.hierarchy import Family, hierarchical_consistency
from tests.unit.evaluate.builders import box, region_of

# --- threshold and filter of LangSplat's LERF rule ------------------------------------------------

RELEVANCY = np.array([[0.30, 0.50, 0.60], [0.44, 0.65, 0.70], [0.52, 0.57, 0.61]])


@pytest.mark.parametrize(
    ("values", "rule", "expected"),
    [
        # min-max: [[0, .5, .75], [.35, .875, 1], [.55, .675, .775]]
        (RELEVANCY, (0.4, "normalised_pm1"), [[0, 0, 1], [0, 1, 1], [0, 0, 1]]),
        (RELEVANCY, (0.4, "raw"), [[0, 1, 1], [1, 1, 1], [1, 1, 1]]),
        (RELEVANCY, (0.0, "normalised_pm1"), [[0, 0, 1], [0, 1, 1], [1, 1, 1]]),  # 0 is not above 0
        (np.full((2, 2), 0.6), (0.4, "normalised_pm1"), [[0, 0], [0, 0]]),
    ],
)
def test_threshold_means_min_max_above_0_7_or_the_raw_value(values, rule, expected):
    np.testing.assert_array_equal(rules.threshold_mask(values, *rule), np.array(expected, dtype=bool))


def test_even_filters_are_anchored_right_of_their_middle():
    impulse = np.zeros((80, 80))
    impulse[40, 40] = 900
    rows, columns = np.nonzero(rules.mean_filter(impulse, 30) > 0.5)
    # output y averages rows y - 15 .. y + 14, so row 40 is seen by y = 26 .. 55
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (26, 55, 26, 55)


def test_filter_reflects_at_the_border_or_averages_what_is_inside():
    row = np.array([[1.0, 2.0, 4.0]])
    # side 3 at column 0: values 2, 1, 2; the single row is its own reflection. Inside: values 1, 2
    np.testing.assert_allclose(rules.mean_filter(row, 3), [[5 / 3, 7 / 3, 8 / 3]], rtol=1e-6)
    np.testing.assert_allclose(rules.mean_filter(row, 3, "inside"), [[1.5, 7 / 3, 3.0]], rtol=1e-6)


def test_filter_scales_with_the_height_unless_it_is_set():
    assert [rules.filter_side_px(0, height) for height in (730, 256, 10)] == [30, 11, 1]  # 256: 10.52
    assert rules.filter_side_px(20, 256) == 20


def test_majority_filter_equals_the_plain_loop_over_windows():
    mask = np.random.default_rng(0).random((13, 17)) > 0.5
    height, width = mask.shape
    expected = np.zeros_like(mask)
    for i in range(height):
        for j in range(width):
            window = mask[max(0, i - 3) : min(i + 4, height - 1), max(0, j - 3) : min(j + 4, width - 1)]
            expected[i, j] = window.sum() * 2 > window.size
    np.testing.assert_array_equal(rules.majority_smooth(mask), expected)


def test_mixing_halves_the_filtered_and_the_raw_map():
    relevancy = np.zeros((3, 6, 6), dtype=np.float32)
    relevancy[:, 2, 3] = 1
    smoothed = rules.SmoothedRelevancy.of(relevancy, rules.RelevancyRule(filter_px=2))
    assert smoothed.mixed[0, 2, 3] == pytest.approx(0.5 * (0.25 + 1))
    assert smoothed.mixed[0, 3, 4] == pytest.approx(0.125)
    assert smoothed.filtered[0, 3, 4] == pytest.approx(0.25)


@pytest.mark.parametrize("level_rule", ["max", "mean_in_mask"])
@pytest.mark.parametrize(
    ("values", "levels", "place"),
    [
        ((0.6, 0.7, 0.9), LEVELS, [1, 1]),
        ((0.6, 0.7, 0.9), LEVELS[:2], [5, 5]),
        ((0.9, 0.9, 0.9), LEVELS, [1, 1]),  # LangSplat stacks s, m, l; argmax takes the first
    ],
)
def test_the_finest_of_the_levels_with_the_highest_value_is_chosen(level_rule, values, levels, place):
    relevancy = np.zeros((3, 8, 8), dtype=np.float32)
    relevancy[0, 2, 2], relevancy[1, 5, 5], relevancy[2, 1, 1] = values
    rule = rules.RelevancyRule(filter_px=1, majority=False, level_rule=level_rule, levels=levels)
    smoothed = rules.SmoothedRelevancy.of(relevancy, rule)
    assert np.argwhere(rules.relevancy_mask(smoothed, None, rule)).tolist() == [place]
    if levels == LEVELS:
        assert masks.peak_points(smoothed.filtered).tolist() == [place]


# --- masks ----------------------------------------------------------------------------------------


def test_boundary_iou_of_a_shifted_square():
    truth, prediction = box((1, 7), (1, 7)), box((1, 7), (2, 8))
    assert [masks.boundary_width_px(size) for size in ((10, 10), (728, 986), (725, 985))] == [1, 25, 24]
    assert masks.iou(prediction, truth) == pytest.approx(30 / 42)
    assert masks.boundary(truth, 1).sum() == 20
    assert masks.boundary(np.ones((10, 10), dtype=bool), 1).sum() == 36  # also at the image border
    assert masks.boundary_iou(prediction, truth) == pytest.approx(10 / 30)
    empty = np.zeros((10, 10), dtype=bool)
    assert masks.iou(empty, empty) == masks.boundary_iou(empty, empty) == 0


def test_every_region_is_compared_with_every_mask():
    regions = np.array([[1, 1, 1, 0, 0], [0, 0, 1, 1, 0]], bool)
    found = np.array([[1, 1, 1, 0, 0], [0, 1, 1, 1, 1], [0, 0, 0, 0, 0]], bool)
    np.testing.assert_allclose(masks.iou_matrix(regions, found), [[1, 2 / 5, 0], [1 / 4, 2 / 4, 0]])
    assert masks.iou_matrix(regions, found[:0]).shape == (2, 0)


def test_one_wide_erosion_equals_many_small_ones():
    import cv2

    mask = np.random.default_rng(1).random((40, 50)) > 0.02
    padded = np.pad(mask.astype(np.uint8), 1)
    repeated = cv2.erode(padded, np.ones((3, 3), np.uint8), iterations=4)[1:-1, 1:-1]
    np.testing.assert_array_equal(masks.boundary(mask, 4), mask & (repeated == 0))


@settings(max_examples=30, deadline=None)
@given(
    hnp.arrays(np.float32, (4, 5), elements=st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0])),
    hnp.arrays(bool, (4, 5)),
)
def test_best_threshold_equals_trying_every_cut(score, truth):
    expected = max(masks.iou(score >= cut, truth) for cut in np.unique(score))
    assert masks.best_threshold_iou(score, truth) == pytest.approx(expected)


# --- every pixel a class --------------------------------------------------------------------------


def test_argmax_protocol_of_3d_ovs_on_four_pixels():
    truth = np.array([[[1, 1, 0, 0]], [[0, 0, 1, 0]], [[0, 0, 0, 1]]], dtype=bool)  # classes 0, 0, 1, 2
    similarity = np.array([[[0.9, 0.1, 0.2, 0.2]], [[0.3, 0.5, 0.4, 0.2]], [[0.1, 0.4, 0.3, 0.3]]])
    prediction = masks.argmax_masks(similarity)  # 0, 1, 1, 2
    assert [masks.iou(prediction[row], truth[row]) for row in range(3)] == [1 / 2, 1 / 2, 1]
    assert masks.pixel_accuracy(prediction, truth) == 0.75
    truth[1, 0, 0] = True  # a pixel with two true classes is never right
    assert masks.pixel_accuracy(prediction, truth) == 0.5
    first, second = masks.argmax_masks(np.zeros((2, 1, 3)))  # equal similarities go to the first class
    assert first.all() and not second.any()


# --- localization ---------------------------------------------------------------------------------


def test_any_of_several_maxima_may_hit_and_borders_count():
    filtered = np.zeros((3, 24, 24), dtype=np.float32)
    filtered[1, 5, 10] = filtered[1, 5, 12] = 0.8
    points = masks.peak_points(filtered)
    assert points.tolist() == [[10, 5], [12, 5]]
    assert masks.hits_a_box(points, np.array([[0, 0, 9, 9], [12, 5, 20, 20]]))
    assert not masks.hits_a_box(points, np.array([[0, 0, 9, 9], [13, 5, 20, 20]]))


def test_mask_hit_is_stricter_than_box_hit():
    truth = box((0, 1), (0, 5)) | box((0, 5), (0, 1))  # an L; its box holds (3, 3)
    point = np.array([[3, 3]])
    boxes = region_of(truth, "L").boxes()
    assert boxes.tolist() == [[0, 0, 4, 4]]
    assert masks.hits_a_box(point, boxes)
    assert not masks.hits_the_mask(point, truth)


# --- hierarchical consistency ---------------------------------------------------------------------


def test_whole_image_fools_all_readings_but_the_anchored_one():
    full = np.ones((10, 10), dtype=bool)
    a, b, a1 = box((0, 10), (0, 5)), box((0, 5), (5, 10)), box((0, 4), (0, 5))
    fooled = [[Family(full, (full, full), a), Family(full, (full,), b)], [Family(full, (full,), a1)]]
    assert hierarchical_consistency(fooled, "containment") == hierarchical_consistency(fooled, "literal") == 1
    # area of the true parents: A 50, B 25, a1 20 of 100 px
    assert hierarchical_consistency(fooled, "anchored") == pytest.approx((0.375 + 0.2) / 2)


def test_majority_inside_the_image_includes_the_last_row_and_column():
    mask = box((4, 8), (4, 8), (8, 8))
    # turned by 180 degrees this is the same square at the other corner, and so is the smoothed mask
    turned = rules.majority_smooth(mask[::-1, ::-1], "inside")[::-1, ::-1]
    np.testing.assert_array_equal(rules.majority_smooth(mask, "inside"), turned)
    # at (7, 7) the window holds rows and columns 4 .. 7: all ones. LangSplat's window drops row and column 7.
    assert rules.majority_smooth(mask, "inside")[7, 7]
    corner = box((7, 8), (0, 8), (8, 8))
    assert not rules.majority_smooth(corner).any()
