"""Properties of every metric; a metric that is not listed fails."""

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilsplat.evaluate.metrics import instances, masks, point_classes
from hilsplat.evaluate.metrics.hierarchy import READINGS, Family, hierarchical_consistency
from hilsplat.evaluate.metrics.point_classes import ClassCounts
from hilsplat.evaluate.protocols import cards

# Every metric as a function of two label images with labels 0 .. 3; the second is the ground truth.
# Masks are where a label is 1; families are label 1 or 2 (parent) with its part of label 2 (child).


def of_masks(function):
    return lambda prediction, truth: function(prediction == 1, truth == 1)


def of_counts(function):
    return lambda prediction, truth: function(ClassCounts.of(truth.ravel(), prediction.ravel(), 3))


def of_instances(thresholds):
    def value(prediction, truth):
        present = [label for label in (1, 2, 3) if (prediction == label).any()]
        matches = instances.match_instances(
            np.where(truth > 0, 1000 + truth, 0).ravel().astype(np.int64),
            np.array([(prediction == label).ravel() for label in present], bool).reshape(-1, truth.size),
            np.ones(len(present), dtype=np.int64),
            np.array(present, dtype=float),
            class_ids=(1,),
            min_points=1,
        )
        return instances.mean_precision(instances.average_precision([matches])[:, thresholds])

    return value


def of_families(reading):
    def value(prediction, truth):
        child = (prediction == 2) | ((prediction == 3) & (truth != 3))  # pixels wrongly labelled 3 spill over
        family = Family(np.isin(prediction, (1, 2)), (child,), np.isin(truth, (1, 2)))
        return hierarchical_consistency([[family]], reading)

    return value


def pixel_accuracy(prediction, truth):
    return masks.pixel_accuracy(*(np.stack([each == n for n in (1, 2, 3)]) for each in (prediction, truth)))


def first_class_occurring(counts):
    return point_classes.miou_over_occurring(counts, np.array([True, False, False]))


CASES = {
    "iou": of_masks(masks.iou),
    "boundary_iou": of_masks(masks.boundary_iou),
    "acc_25": of_masks(lambda mask, truth: float(masks.iou(mask, truth) > 0.25)),
    "acc_50": of_masks(lambda mask, truth: float(masks.iou(mask, truth) > 0.5)),
    "best_threshold_iou": of_masks(lambda mask, truth: masks.best_threshold_iou(mask / 1.0, truth)),
    "pixel_accuracy": pixel_accuracy,
    **{f"hc_{reading}": of_families(reading) for reading in READINGS},
    "view_consistency": of_masks(masks.iou),  # of two views' masks over the points that both show
    "class_iou": of_counts(lambda counts: float(point_classes.class_iou(counts)[0])),
    "class_accuracy": of_counts(lambda counts: float(point_classes.class_accuracy(counts)[0])),
    "miou_present": of_counts(point_classes.miou_over_present),
    "macc_present": of_counts(point_classes.macc_over_present),
    "miou_occurring": of_counts(point_classes.miou_over_occurring),
    **{f"miou_{split}": of_counts(first_class_occurring) for split in ("head", "common", "tail")},
    "miou_all": of_counts(point_classes.miou_over_all),
    "macc_all": of_counts(point_classes.macc_over_all),
    "miou_absent_as_one": of_counts(point_classes.miou_absent_as_one),
    "frequency_weighted_iou": of_counts(point_classes.frequency_weighted_iou),
    **dict.fromkeys(("ap", "ap_head", "ap_common", "ap_tail"), of_instances(slice(-1))),
    "ap50": of_instances([0]),
    "ap25": of_instances([-1]),
}
SYMMETRIC = ("iou", "boundary_iou", "acc_25", "acc_50", "pixel_accuracy", "view_consistency")
IMPERFECT = ("hc_literal", "miou_all", "macc_all")
"""Metrics whose value for a perfect prediction depends on the truth."""

label_images = hnp.arrays(np.int64, (4, 5), elements=st.integers(0, 3))
truths = label_images.filter(lambda labels: all((labels == label).any() for label in (1, 2, 3)))
few = settings(max_examples=15, deadline=None)  # each example runs every metric


def test_every_metric_of_a_protocol_has_a_case():
    assert set(CASES) == {metric for card in cards.CARDS for metric in card.metrics} - set(cards.LOCALIZATION)


@few
@given(prediction=label_images, truth=truths)
def test_metrics_are_shares_also_of_mirrored_scenes(prediction, truth):
    for name, metric in CASES.items():
        value = metric(prediction, truth)
        assert 0 <= value <= 1 + 1e-12, name  # rounding of a mean
        assert value == pytest.approx(metric(prediction[:, ::-1], truth[:, ::-1])), name


@few
@given(truth=truths)
def test_perfect_predictions_score_one_and_missing_ones_zero(truth):
    for name, metric in CASES.items():
        if name not in IMPERFECT:
            assert metric(truth, truth) == pytest.approx(1), name
    # a pixel without any true class is rightly predicted as none, so give every pixel a class
    truth = np.where(truth == 0, 1, truth)
    for name, metric in CASES.items():
        if name != "best_threshold_iou":  # a diagnostic: the truth chooses the threshold
            assert metric(np.zeros((4, 5), dtype=np.int64), truth) == 0, name


@few
@given(first=label_images, second=label_images)
def test_metrics_that_compare_two_masks_are_symmetric(first, second):
    for name in SYMMETRIC:
        assert CASES[name](first, second) == CASES[name](second, first), name
