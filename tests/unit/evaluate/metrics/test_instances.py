"""Average precision of instances: the worked examples, and the rules of matching one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.evaluate.metrics import instances

CLASS = 4


def scan_of(truth, predictions, classes=None):
    """Truth as (instance, points) runs of class 4; predictions as (first, stop, confidence)."""
    points = np.concatenate([np.full(count, value) for value, count in truth])
    masks = np.zeros((len(predictions), len(points)), dtype=bool)
    for mask, (first, stop, _) in zip(masks, predictions, strict=True):
        mask[first:stop] = True
    return (
        points.astype(np.int64),
        masks,
        np.array(classes or [CLASS] * len(predictions), dtype=np.int64),
        np.array([confidence for *_, confidence in predictions], dtype=float),
    )


def precisions(*scans, class_ids=(CLASS,), min_points=1):
    return instances.average_precision(
        [instances.match_instances(*scan, class_ids, min_points) for scan in scans]
    )


A, B, VOID = 4001, 4002, 0
EXAMPLE = [(A, 4), (B, 3), (VOID, 3)]


def test_worked_example_of_ten_vertices():
    # p1 is A; p2 is in void; p3 = points 3-5 shares 2 of 4 with B
    result = precisions(scan_of(EXAMPLE, [(0, 4, 0.9), (7, 9, 0.8), (3, 6, 0.6)]))
    assert result[0] == pytest.approx([0.5] * 9 + [1.0])  # above 0.5 .. 0.9, and above 0.25


def test_area_under_the_curves_of_the_worked_examples():
    assert instances.curve_area(np.array([0.9, 0.6]), np.array([True, False]), 1) == pytest.approx(0.5)
    # P = 2/3, 1/2, 1, 1 and R = 2/3, 1/3, 1/3, 0: every step is 1/6
    three = np.array([True, False, True])
    assert instances.curve_area(np.array([0.9, 0.8, 0.6]), three, 1) == pytest.approx(0.527778, abs=1e-6)
    assert instances.curve_area(np.ones(3), three, 1) == pytest.approx(0.555556, abs=1e-6)
    assert instances.curve_area(np.zeros(0), np.zeros(0, dtype=bool), 2) == 0


def test_perfect_instances_score_one_missing_ones_zero_and_an_absent_class_nothing():
    assert precisions(scan_of(EXAMPLE, [(0, 4, 0.9), (4, 7, 0.8)])).tolist() == [[1.0] * 10]
    result = precisions(scan_of(EXAMPLE, []), class_ids=(CLASS, 9))
    assert result[0].tolist() == [0.0] * 10
    assert np.isnan(result[1]).all()
    assert instances.mean_precision(result) == 0
    assert np.isnan(instances.mean_precision(result[1:]))


@pytest.mark.parametrize(
    ("truth", "predictions", "overlap", "entries"),
    [
        # both overlap A by more than 0.5, 3 of 4 and 4 of 4: the more confident is the match, in any order
        ([(A, 4), (VOID, 4)], [(0, 3, 0.3), (0, 4, 0.9)], 0, [(0.3, False), (0.9, True)]),
        ([(A, 4), (VOID, 4)], [(0, 4, 0.9), (0, 3, 0.3)], 0, [(0.3, False), (0.9, True)]),
        # at 0.25 the second prediction covers A and B: a false positive on A and the match of B
        ([(A, 4), (B, 4)], [(0, 4, 0.9), (0, 8, 0.8)], -1, [(0.8, False), (0.8, True), (0.9, True)]),
    ],
)
def test_a_second_match_is_a_false_positive_and_may_be_the_first_of_another(
    truth, predictions, overlap, entries
):
    matches = instances.match_instances(*scan_of(truth, predictions), (CLASS,), 1)
    kept = matches.overlap_index == range(len(instances.OVERLAPS))[overlap]
    found = zip(matches.confidence[kept].tolist(), matches.is_match[kept].tolist(), strict=True)
    assert sorted(found) == entries
    assert matches.misses[0, overlap] == 0


def test_only_the_first_match_marks_a_prediction_as_used():
    # one prediction over A and B overlaps each by 4 of 8 > 0.25: it matches A, and B is missed
    matches = instances.match_instances(*scan_of([(A, 4), (B, 4)], [(0, 8, 0.9)]), (CLASS,), 1)
    quarter = len(instances.OVERLAPS) - 1
    assert matches.is_match[matches.overlap_index == quarter].tolist() == [True]
    assert matches.misses[0, quarter] == 1


HALF_VOID, OTHER = [(A, 4), (VOID, 4)], [(A, 4), (9001, 4)]
TWO_OTHERS = [(A, 4), (9001, 4), (VOID, 4)]


@pytest.mark.parametrize(
    ("truth", "predictions", "class_ids", "expected"),
    [
        # half of the more confident one is in void, not more than 0.5: a false positive.
        # P = 1/2, 0, 1 and R = 1, 0, 0: 1/2 * (1 - 0) / 2
        (HALF_VOID, [(0, 4, 0.9), (2, 6, 0.95)], (CLASS,), 0.25),
        (HALF_VOID, [(0, 4, 0.9), (3, 7, 0.95)], (CLASS,), 1),  # three quarters of it: ignored
        # the more confident one is on an object of another class: P = 1/2 at R = 1
        (OTHER, [(0, 4, 0.5), (4, 8, 0.9)], (CLASS, 9), 0.25),
        (OTHER, [(0, 4, 0.5), (4, 8, 0.9)], (CLASS,), 1),  # void if class 9 is not evaluated
        (TWO_OTHERS, [(0, 4, 0.5), (4, 8, 0.9), (8, 12, 0.8)], (CLASS, 9), 0.25),  # only one is in void
    ],
)
def test_predictions_in_void_are_ignored_and_others_are_false_positives(
    truth, predictions, class_ids, expected
):
    assert precisions(scan_of(truth, predictions), class_ids=class_ids)[0, 0] == pytest.approx(expected)


def test_small_instances_and_predictions_and_other_classes_do_not_count():
    # B has 3 points, fewer than 4. Its prediction is in an ignored instance, so it is ignored too.
    scan = scan_of(EXAMPLE, [(0, 4, 0.9), (4, 8, 0.8)])
    assert precisions(scan, min_points=4).tolist() == [[1.0] * 10]
    # Half of the first prediction is in B and half in void: together, all of it is ignored.
    half_each = precisions(scan_of(EXAMPLE, [(4, 10, 0.9), (0, 4, 0.8)]), min_points=4)
    assert half_each.tolist() == [[1.0] * 10]
    scan = scan_of(EXAMPLE, [(0, 3, 0.9), (0, 4, 0.8)], classes=[CLASS, 77])
    assert precisions(scan, min_points=4).tolist() == [[0.0] * 10]


def test_masks_of_other_points_are_refused():
    with pytest.raises(MisalignedArtifactError, match=r"expected  3 points\n  found     4"):
        instances.match_instances(
            np.zeros(3, int), np.ones((1, 4), bool), np.array([CLASS]), np.ones(1), (CLASS,)
        )


# --- a second implementation ----------------------------------------------------------------------


def plain_curve(entries, misses):
    """Precision and recall counted anew at every confidence, then the stated sum."""
    if not entries:
        return 0.0
    precision, recall = [], []
    for least in sorted({confidence for confidence, _ in entries}):
        taken = [hit for confidence, hit in entries if confidence >= least]
        below = sum(hit for confidence, hit in entries if confidence < least)
        precision.append(sum(taken) / len(taken))
        truths = sum(taken) + below + misses
        recall.append(sum(taken) / truths if truths else 0.0)
    precision, recall = [*precision, 1.0], [*recall, 0.0]
    before, after = [recall[0], *recall], [*recall[1:], 0.0]
    return sum(p * (r0 - r1) / 2 for p, r0, r1 in zip(precision, before[:-1], after, strict=True))


@given(
    st.lists(st.tuples(st.sampled_from([0.1, 0.4, 0.5, 0.9]), st.booleans()), max_size=12), st.integers(0, 4)
)
def test_area_equals_the_plain_sum_and_is_bounded(entries, misses):
    confidence = np.array([value for value, _ in entries], dtype=float)
    area = instances.curve_area(confidence, np.array([hit for _, hit in entries], dtype=bool), misses)
    assert area == pytest.approx(plain_curve(entries, misses))
    assert 0 <= area <= 1 + 1e-12  # rounding of a sum of a dozen shares
