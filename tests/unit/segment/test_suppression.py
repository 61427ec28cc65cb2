"""Suppression of boxes and masks against small cases by hand and LangSplat's double loop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilsplat.segment import suppression
from hilsplat.settings import MasksSettings
from tests.unit.segment import official
from tests.unit.segment.handmade import assert_equal_masks, pack

shapes = st.tuples(st.integers(1, 8), st.just(3), st.just(5))
nonempty_masks = hnp.arrays(bool, shapes).filter(lambda masks: masks.any(axis=(1, 2)).all())
scores_of = st.sampled_from([0.1, 0.25, 0.5, 0.75, 1.0])


def test_box_iou_by_hand():
    a = np.array([[0, 0, 4, 4]])
    b = np.array([[0, 0, 4, 4], [2, 0, 6, 4], [4, 0, 8, 4]])
    assert suppression.box_iou(a, b)[0].tolist() == [1.0, pytest.approx(8 / 24), 0.0]


@pytest.mark.parametrize(
    ("boxes", "score", "iou_max", "kept"),
    [
        # the best box drops its neighbour
        ([[0, 0, 10, 10], [0, 0, 10, 9], [20, 20, 30, 30]], [0.5, 0.9, 0.1], 0.7, [1, 2]),
        # a dropped box drops no other: 0-1 and 1-2 overlap by 0.6, 0-2 by a third
        ([[0, 0, 8, 1], [2, 0, 10, 1], [4, 0, 12, 1]], [0.9, 0.8, 0.7], 0.5, [0, 2]),
        # at the same score and area, the box further left is kept
        ([[1, 0, 11, 10], [0, 0, 10, 10]], [0.5, 0.5], 0.7, [1]),
    ],
)
def test_boxes_are_dropped_by_better_ones_that_are_kept(boxes, score, iou_max, kept):
    assert suppression.suppress_boxes(np.array(boxes), np.array(score), iou_max).tolist() == kept


def test_a_box_repeats_a_better_one_unless_it_is_more_stable():
    box = [0, 0, 10, 10]
    boxes = np.array([box, box, box, box, [0, 0, 10, 8]])
    score = np.array([0.5, 0.9, 0.8, 0.7, 0.6])
    stability = np.array([0.25, 0.5, 0.75, 0.75 + 2**-20, 0.125])  # exact in binary
    # 1 is best; 0 and 2 repeat it, although 2 is more stable by exactly the slack; 3 is more stable by more
    # than that; 4 has an IoU of 0.8 with all others
    assert suppression.distinct_boxes(boxes, score, 0.85, stability, slack=0.25).tolist() == [1, 3, 4]


@given(st.integers(0, 1000), st.sampled_from([0.2, 0.5, 0.8]), st.sampled_from([0.2, 0.5, 0.8]))
def test_distinct_boxes_lead_to_the_same_suppression_at_any_threshold(seed, score_min, stability_min):
    rng = np.random.default_rng(seed)
    copies = rng.integers(0, 4, 40)  # four regions, each many times with the very same box
    boxes = np.array([[0, 0, 10, 10], [20, 0, 30, 10], [0, 20, 10, 30], [20, 20, 30, 30]])[copies]
    score, stability = rng.permutation(40) / 40, rng.random(40)

    def best(rows: np.ndarray) -> list[int]:
        rows = rows[(score[rows] > score_min) & (stability[rows] >= stability_min)]
        return rows[suppression.suppress_boxes(boxes[rows], score[rows], iou_max=0.7)].tolist()

    assert best(np.sort(suppression.distinct_boxes(boxes, score, 0.9, stability))) == best(np.arange(40))


@given(
    nonempty_masks,
    st.data(),
    st.sampled_from([0.3, 0.6, 0.8]),
    st.sampled_from([0.0, 0.3]),
    st.sampled_from([0.0, 0.2, 0.5]),
)
def test_kept_masks_equal_langsplats(masks, data, iou_max, score_min, inner):
    score = np.array(data.draw(st.lists(scores_of, min_size=len(masks), max_size=len(masks))))
    keep = suppression.keep_best_masks(
        pack(masks).overlaps_px(), score, iou_max=iou_max, score_min=score_min, inner=inner
    )
    expected = official.suppress(masks, score, MasksSettings(nms_iou=iou_max, nms_inner=inner), score_min)
    assert np.flatnonzero(keep).tolist() == expected


@given(nonempty_masks, st.data())
def test_result_does_not_depend_on_the_order_of_masks(masks, data):
    number = len(masks)
    score = np.array(data.draw(st.lists(scores_of, min_size=number, max_size=number)), np.float32)
    level = np.array(data.draw(st.lists(st.integers(1, 3), min_size=number, max_size=number)), np.uint8)
    shuffle = np.array(data.draw(st.permutations(range(number))))
    first, second = (
        suppression.suppress_masks(
            pack(masks[order], level[order], score[order]), iou_max=0.8, score_min=0.2, inner=0.5
        )
        for order in (np.arange(number), shuffle)
    )
    assert_equal_masks(second, first)
