"""Classes of points: the worked example under each benchmark's mean, and Waymo's own regression test."""

import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilsplat.evaluate.metrics.point_classes import (
    ClassCounts,
    class_accuracy,
    class_iou,
    frequency_weighted_iou,
    macc_over_all,
    macc_over_present,
    miou_absent_as_one,
    miou_over_all,
    miou_over_occurring,
    miou_over_present,
    pooled,
)
from tests.conftest import PROJECT

TRUTH = np.array([1, 1, 1, 1, 2, 2, 3, 3, 0, 0])
PREDICTION = np.array([1, 1, 2, 4, 2, 2, 3, 1, 1, 2])


def example():
    return ClassCounts.of(TRUTH, PREDICTION, 4)


def test_ious_and_accuracies_of_the_worked_example():
    # class 1: 2 hits of 4 true and 3 predicted, the one on ignored truth left out: 2 / (4 + 3 - 2)
    np.testing.assert_allclose(class_iou(example()), [2 / 5, 2 / 3, 1 / 2, 0])
    np.testing.assert_allclose(class_accuracy(example()), [1 / 2, 1, 1 / 2, np.nan])


@pytest.mark.parametrize(
    ("mean", "expected"),
    [
        (miou_over_present, (2 / 5 + 2 / 3 + 1 / 2) / 3),
        (macc_over_present, (1 / 2 + 1 + 1 / 2) / 3),
        # class 4 occurs in the prediction alone and counts 0
        (miou_over_occurring, (2 / 5 + 2 / 3 + 1 / 2 + 0) / 4),
        (miou_over_all, (2 / 5 + 2 / 3 + 1 / 2 + 0) / 4),
        (macc_over_all, (1 / 2 + 1 + 1 / 2) / 4),
        # 4, 2 and 2 points of the classes
        (frequency_weighted_iou, (4 * 2 / 5 + 2 * 2 / 3 + 2 * 1 / 2) / 8),
    ],
)
def test_means_of_the_worked_example(mean, expected):
    assert mean(example()) == pytest.approx(expected)


def test_means_differ_for_a_class_that_occurs_nowhere():
    counts = ClassCounts.of(TRUTH, PREDICTION, 5)
    assert miou_over_occurring(counts) == pytest.approx(0.391667, abs=1e-6)
    assert miou_over_all(counts) == pytest.approx((2 / 5 + 2 / 3 + 1 / 2) / 5)
    assert miou_absent_as_one(counts) == pytest.approx((2 / 5 + 2 / 3 + 1 / 2 + 1) / 5)


def test_means_among_some_classes():
    among = np.array([True, False, False, True])
    assert miou_over_occurring(example(), among) == pytest.approx((2 / 5 + 0) / 2)
    assert np.isnan(miou_over_occurring(example(), np.zeros(4, dtype=bool)))


def test_mean_over_scenes_and_pooled_scenes_differ():
    # scene 1: intersection 1, union 2; scene 2: 8 of 8
    first = ClassCounts.of(np.array([1, 1]), np.array([1, 0]), 1)
    second = ClassCounts.of(np.ones(8, int), np.ones(8, int), 1)
    assert (class_iou(first)[0] + class_iou(second)[0]) / 2 == 0.75
    assert class_iou(pooled([first, second]))[0] == 0.9


def test_scene_without_truth_has_no_mean():
    counts = ClassCounts.of(np.zeros(3, int), np.array([1, 2, 0]), 2)
    assert np.isnan(miou_over_present(counts))
    assert np.isnan(macc_over_present(counts))
    assert np.isnan(frequency_weighted_iou(counts))


labels = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=30)


@settings(max_examples=30, deadline=None)
@given(labels, st.randoms(use_true_random=False))
def test_order_of_points_and_names_of_classes_do_not_matter(pairs, random):
    truth, prediction = np.array(pairs).T
    counts = ClassCounts.of(truth, prediction, 4)
    order = random.sample(range(len(pairs)), len(pairs))
    renamed = np.array([0, *random.sample(range(1, 5), 4)])
    other = ClassCounts.of(renamed[truth[order]], renamed[prediction[order]], 4)
    for mean in (miou_over_present, macc_over_present, miou_over_all, frequency_weighted_iou):
        assert mean(other) == pytest.approx(mean(counts), nan_ok=True)


@settings(max_examples=30, deadline=None)
@given(labels)
def test_ious_equal_those_of_the_masks_of_each_class(pairs):
    truth, prediction = np.array(pairs).T
    prediction = np.where(truth > 0, prediction, 0)
    for row, value in enumerate(class_iou(ClassCounts.of(truth, prediction, 4))):
        union = np.count_nonzero((truth == row + 1) | (prediction == row + 1))
        both = np.count_nonzero((truth == row + 1) & (prediction == row + 1))
        assert value == pytest.approx(both / union if union else np.nan, nan_ok=True)


# --- Waymo's regression test ----------------------------------------------------------------------
# The protocol buffers are decoded here from their public layout; reading real frames is out of scope.


def varint(data, place):
    """The integer at a place, and the next place."""
    value = shift = 0
    while True:
        byte = data[place]
        value |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return value, place


def fields_of(data):
    """(field number, value) of a message: integers and bytes are all that occurs."""
    place = 0
    while place < len(data):
        key, place = varint(data, place)
        if key & 7 == 0:
            value, place = varint(data, place)
        else:
            assert key & 7 == 2, "unknown wire type"
            length, place = varint(data, place)
            value, place = data[place : place + length], place + length
        yield key >> 3, value


def classes_of(range_image):
    """Classes of a range image: field 6 holds a compressed matrix, its field 1 packed integers."""
    matrix = dict(fields_of(zlib.decompress(dict(fields_of(range_image))[6])))
    packed, place, values = matrix[1], 0, []
    while place < len(packed):
        value, place = varint(packed, place)
        values.append(value)
    return np.array(values)


def frames_of(path):
    """{(context, timestamp): classes of both returns} of a list of frames."""
    frames = {}
    for _, frame in fields_of(path.read_bytes()):
        parts = dict(fields_of(frame))
        laser = dict(fields_of(parts[1]))
        assert laser[1] == 1, "the TOP lidar"
        frames[parts[2], parts[3]] = np.concatenate([classes_of(laser[2]), classes_of(laser[3])])
    return frames


def test_waymo_regression_value():
    """CAR and PEDESTRIAN 0.0434832, all else 0, mIoU 0.00395302: stated in Waymo's metrics tool."""
    folder = PROJECT.parent / "shared" / "reference" / "samples" / "waymo"
    if not folder.is_dir():
        pytest.skip("Waymo's two test files are not beside the checkout (shared/reference/samples/waymo)")
    truth = frames_of(folder / "fake_segmentation_groundtruths.bin")
    prediction = frames_of(folder / "fake_segmentation_predictions.bin")
    assert len(truth) == 6
    assert all(len(labels) == 2 * 50 * 1000 for labels in truth.values())
    counts = pooled(ClassCounts.of(labels, prediction[frame], 22) for frame, labels in truth.items())
    expected = np.zeros(22)
    expected[[0, 6]] = 0.0434832  # 1 CAR, 7 PEDESTRIAN
    np.testing.assert_allclose(class_iou(counts), expected, atol=5e-8)
    assert miou_absent_as_one(counts) == pytest.approx(0.00395302, abs=5e-9)
