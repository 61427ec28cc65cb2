"""Properties of every metric; a metric that is not listed fails."""

import importlib
from functools import partial

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilsplat.evaluate import metrics
from hilsplat.evaluate.metrics.hierarchy import (
    READINGS,
    Family,
    consistency_per_child,
    hierarchical_consistency,
)
from hilsplat.evaluate.metrics.instances import ap, ap25, ap50, average_precision, match_instances
from hilsplat.evaluate.metrics.localization import box_of, hits_a_box, hits_the_mask
from hilsplat.evaluate.metrics.masks import best_threshold_iou, boundary_iou, exceeds, iou, pixel_accuracy
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
)
from hilsplat.evaluate.metrics.registry import METRICS

# Every metric as a function of two label images with labels 0 .. 3, of which the second is the truth.
# Masks are where a label is 1; families are label 1 or 2 (parent) with its part of label 2 (child).


def of_masks(function):
    return lambda prediction, truth: function(prediction == 1, truth == 1)


def of_counts(function, num_classes=3):
    return lambda prediction, truth: function(ClassCounts.of(truth.ravel(), prediction.ravel(), num_classes))


def of_instances(function):
    def value(prediction, truth):
        present = [label for label in (1, 2, 3) if (prediction == label).any()]
        matches = match_instances(
            np.where(truth > 0, 1000 + truth, 0).ravel().astype(np.int64),
            np.array([(prediction == label).ravel() for label in present], bool).reshape(-1, truth.size),
            np.ones(len(present), dtype=np.int64),
            np.array(present, dtype=float),
            class_ids=(1,),
            min_points=1,
        )
        return function(average_precision([matches]))

    return value


def of_families(consistency):
    def value(prediction, truth):
        child = (prediction == 2) | ((prediction == 3) & (truth != 3))  # pixels wrongly labelled 3 spill over
        family = Family(np.isin(prediction, (1, 2)), (child,), np.isin(truth, (1, 2)))
        return consistency([[family]])

    return value


def of_points(hit):
    """The point is the middle pixel of the predicted mask; no mask, no point."""

    def value(prediction, truth):
        rows, columns = np.nonzero(prediction == 1)
        middle = slice(len(rows) // 2, len(rows) // 2 + 1)
        return float(hit(np.stack([columns, rows], axis=1)[middle], truth == 1))

    return value


def one_hot(labels):
    return np.stack([labels == label for label in range(1, 4)])


def first_class(values):
    return float(values[0])


def first_class_occurring(counts):
    return miou_over_occurring(counts, np.array([True, False, False]))


CASES = {
    "iou": of_masks(iou),
    "boundary_iou": of_masks(boundary_iou),
    "acc_25": of_masks(lambda prediction, truth: exceeds(prediction, truth, 0.25)),
    "acc_50": of_masks(lambda prediction, truth: exceeds(prediction, truth, 0.5)),
    "best_threshold_iou": of_masks(lambda prediction, truth: best_threshold_iou(prediction / 1.0, truth)),
    "localization_box": of_points(lambda points, truth: hits_a_box(points, box_of(truth)[None])),
    "localization_mask": of_points(hits_the_mask),
    "pixel_accuracy": lambda prediction, truth: pixel_accuracy(one_hot(prediction), one_hot(truth)),
    **{
        f"hc_{reading}{suffix}": of_families(
            partial(hierarchical_consistency, reading=reading, pooled=bool(suffix))
        )
        for reading in READINGS
        for suffix in ("", "_pooled")
    },
    "hc_containment_per_child": of_families(consistency_per_child),
    "view_consistency": of_masks(iou),  # of two views' masks over the points that both show
    "class_iou": of_counts(lambda counts: first_class(class_iou(counts))),
    "class_accuracy": of_counts(lambda counts: first_class(class_accuracy(counts))),
    "miou_present": of_counts(miou_over_present),
    "macc_present": of_counts(macc_over_present),
    "miou_occurring": of_counts(miou_over_occurring),
    **{f"miou_{split}": of_counts(first_class_occurring) for split in ("head", "common", "tail")},
    "miou_all": of_counts(miou_over_all),
    "macc_all": of_counts(macc_over_all),
    "miou_absent_as_one": of_counts(miou_absent_as_one),
    "frequency_weighted_iou": of_counts(frequency_weighted_iou),
    "ap": of_instances(ap),
    "ap50": of_instances(ap50),
    "ap25": of_instances(ap25),
    **{f"ap_{split}": of_instances(ap) for split in ("head", "common", "tail")},
}

label_images = hnp.arrays(np.int64, (4, 5), elements=st.integers(0, 3))
truths = label_images.filter(lambda labels: all((labels == label).any() for label in (1, 2, 3)))
few = settings(max_examples=15, deadline=None)  # each example runs every metric
NOTHING = np.zeros((4, 5), dtype=np.int64)


def test_every_metric_has_a_case():
    assert set(CASES) == set(METRICS)


def test_every_metric_names_its_function():
    for metric in METRICS.values():
        module, name = metric.function.split(".")
        assert callable(getattr(importlib.import_module(f"{metrics.__name__}.{module}"), name))


@few
@given(prediction=label_images, truth=truths)
def test_metrics_are_shares(prediction, truth):
    for name in METRICS:
        assert 0 <= CASES[name](prediction, truth) <= 1 + 1e-12, name  # rounding of a mean


@few
@given(truth=truths)
def test_perfect_predictions_reach_the_value_that_is_stated(truth):
    for name, metric in METRICS.items():
        value = CASES[name](truth, truth)
        if metric.perfect is None:
            assert 0 <= value <= 1, name
        else:
            assert value == pytest.approx(metric.perfect), name


@few
@given(truth=truths)
def test_missing_predictions_count_zero(truth):
    # a pixel without any true class is rightly predicted as none, so give every pixel a class
    truth = np.where(truth == 0, 1, truth)
    for name, metric in METRICS.items():
        if not metric.uses_truth_to_choose:
            assert CASES[name](NOTHING, truth) == 0, name


@few
@given(first=label_images, second=label_images)
def test_symmetric_metrics_are_symmetric(first, second):
    for name, metric in METRICS.items():
        if metric.symmetric:
            assert CASES[name](first, second) == CASES[name](second, first), name


def test_others_have_a_pair_that_shows_they_are_not():
    rng = np.random.default_rng(0)
    pairs = []
    for first, other in rng.integers(0, 4, (60, 2, 4, 5)):
        second = np.where(rng.random((4, 5)) < 0.3, other, first)  # alike enough for instances to match
        if all((labels == label).any() for labels in (first, second) for label in (1, 2, 3)):
            pairs += [(first, second), (first, np.where(second == 3, 0, second))]
    for name, metric in METRICS.items():
        if not metric.symmetric:
            differing = (
                pair for pair in pairs if not np.isclose(CASES[name](*pair), CASES[name](*pair[::-1]))
            )
            assert next(differing, None) is not None, f"{name} looks symmetric: list it as such"


@few
@given(prediction=label_images, truth=truths)
def test_mirrored_scenes_score_alike(prediction, truth):
    for name in METRICS:
        if not name.startswith("localization"):  # mirroring a mask moves its middle pixel
            mirrored = CASES[name](prediction[:, ::-1], truth[:, ::-1])
            assert CASES[name](prediction, truth) == pytest.approx(mirrored), name
