"""Classes of points: the worked example under each benchmark's mean, and Waymo's own regression test."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilsplat.datasets.waymo.records import matrix, message_classes
from hilsplat.evaluate.metrics import point_classes as metrics
from tests.conftest import PROJECT

TRUTH = np.array([1, 1, 1, 1, 2, 2, 3, 3, 0, 0])
PREDICTION = np.array([1, 1, 2, 4, 2, 2, 3, 1, 1, 2])
IOU, ACCURACY = 2 / 5 + 2 / 3 + 1 / 2, 1 / 2 + 1 + 1 / 2
"""Sums over the three classes of the truth; class 4 occurs in the prediction alone, and class 5 nowhere."""


@pytest.mark.parametrize(
    ("mean", "expected"),
    [
        ("miou_present", IOU / 3),
        ("macc_present", ACCURACY / 3),
        ("miou_occurring", IOU / 4),
        ("miou_all", IOU / 5),
        ("macc_all", ACCURACY / 5),
        ("miou_absent_as_one", (IOU + 1) / 5),
        # 4, 2 and 2 points of the classes
        ("frequency_weighted_iou", (4 * 2 / 5 + 2 * 2 / 3 + 2 * 1 / 2) / 8),
    ],
)
def test_means_of_the_worked_example(mean, expected):
    assert metrics.MEANS[mean](metrics.ClassCounts.of(TRUTH, PREDICTION, 5)) == pytest.approx(expected)


def test_a_mean_may_be_among_some_classes_and_a_scene_without_truth_has_none():
    counts = metrics.ClassCounts.of(TRUTH, PREDICTION, 5)
    among = np.array([True, False, False, True, True])
    assert metrics.miou_over_occurring(counts, among) == pytest.approx((2 / 5 + 0) / 2)
    assert np.isnan(metrics.miou_over_occurring(counts, np.zeros(5, dtype=bool)))
    nothing = metrics.ClassCounts.of(np.zeros(3, int), np.array([1, 2, 0]), 2)
    for mean in ("miou_present", "macc_present", "frequency_weighted_iou"):
        assert np.isnan(metrics.MEANS[mean](nothing))


labels = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=30)


@settings(max_examples=30, deadline=None)
@given(labels)
def test_ious_equal_those_of_the_masks_of_each_class(pairs):
    truth, prediction = np.array(pairs).T
    prediction = np.where(truth > 0, prediction, 0)
    for row, value in enumerate(metrics.class_iou(metrics.ClassCounts.of(truth, prediction, 4))):
        union = np.count_nonzero((truth == row + 1) | (prediction == row + 1))
        both = np.count_nonzero((truth == row + 1) & (prediction == row + 1))
        assert value == pytest.approx(both / union if union else np.nan, nan_ok=True)


# --- Waymo's regression test ----------------------------------------------------------------------

FRAMES = message_classes("""
RangeImage: optional bytes segmentation_label_compressed 6
Laser: required int32 name 1, optional RangeImage ri_return1 2, optional RangeImage ri_return2 3
Frame: required Laser labels 1, required string context 2, required int64 timestamp 3
Frames: repeated Frame frames 1
""")["Frames"]


def frames_of(path):
    """{(context, timestamp): classes of both returns of the top lidar}."""
    return {
        (frame.context, frame.timestamp): np.concatenate(
            [
                matrix(image.segmentation_label_compressed, np.int32).ravel()
                for image in (frame.labels.ri_return1, frame.labels.ri_return2)
            ]
        )
        for frame in FRAMES.FromString(path.read_bytes()).frames
    }


def test_waymo_regression_value():
    """CAR and PEDESTRIAN 0.0434832, all else 0, mIoU 0.00395302: stated in Waymo's metrics tool."""
    folder = PROJECT.parent / "shared" / "reference" / "samples" / "waymo"
    if not folder.is_dir():
        pytest.skip("Waymo's two test files are not beside the checkout (shared/reference/samples/waymo)")
    truth = frames_of(folder / "fake_segmentation_groundtruths.bin")
    prediction = frames_of(folder / "fake_segmentation_predictions.bin")
    assert len(truth) == 6
    counts = metrics.ClassCounts.of(
        *(np.concatenate([of[frame] for frame in truth]) for of in (truth, prediction)), 22
    )
    expected = np.zeros(22)
    expected[[0, 6]] = 0.0434832  # 1 CAR, 7 PEDESTRIAN
    np.testing.assert_allclose(metrics.class_iou(counts), expected, atol=5e-8)
    assert metrics.MEANS["miou_absent_as_one"](counts) == pytest.approx(0.00395302, abs=5e-9)
