"""Masks and class maps that a method supplies."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.evaluate.protocols.cards import (
    LERF_MASK,
    LERF_MASK_SKIPPING,
    LERF_OPENGAUSSIAN,
    PROTOCOLS,
)
from hilsplat.evaluate.protocols.masks import measure_class_maps, measure_masks
from hilsplat.evaluate.protocols.totals import table_value
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from tests.unit.evaluate.protocols.test_totals import rows_of


def strip(first, last):
    """A mask of columns first .. last of ten."""
    mask = np.zeros((1, 10), dtype=bool)
    mask[0, first : last + 1] = True
    return mask


# view 1: apple 8 of 10, egg 3 of 10; view 2: apple 6 of 10. The example of the averaging orders.
TRUTHS = {"1": {"apple": strip(0, 9), "egg": strip(0, 9)}, "2": {"apple": strip(0, 9)}}
ANSWERS = {"1": {"apple": strip(0, 7), "egg": strip(0, 2)}, "2": {"apple": strip(0, 5)}}


def values_of(card, answers, metric="iou", truths=TRUTHS):
    """(view, text) -> value, as rows carry them."""
    return {
        (view, row.query): row.value
        for view, truth in truths.items()
        for row in measure_masks(card, "ours", answers.get(view, {}), truth)
        if row.metric == metric
    }


def scene_value(card, values):
    """A scene's number in the order of its protocol."""
    return table_value(rows_of(card, values), "iou")


def test_lerf_mask_averages_views_then_prompts():
    assert scene_value(LERF_MASK, values_of(LERF_MASK, ANSWERS)) == pytest.approx(0.5)
    pairs = scene_value(LERF_OPENGAUSSIAN, values_of(LERF_OPENGAUSSIAN, ANSWERS))
    assert pairs == pytest.approx(0.566667, abs=1e-6)


def test_missing_prediction_counts_zero_unless_the_protocol_skips_it():
    answers = {"1": {"apple": strip(0, 7), "egg": None}, "2": {}}
    assert values_of(LERF_MASK, answers) == {("1", "apple"): 0.8, ("1", "egg"): 0, ("2", "apple"): 0}
    assert values_of(LERF_MASK_SKIPPING, answers) == {("1", "apple"): 0.8}
    assert scene_value(LERF_MASK, values_of(LERF_MASK, answers)) == pytest.approx((0.4 + 0) / 2)


def test_accuracies_count_pairs_above_the_threshold():
    assert scene_value(LERF_OPENGAUSSIAN, values_of(LERF_OPENGAUSSIAN, ANSWERS, "acc_25")) == 1
    half = values_of(LERF_OPENGAUSSIAN, ANSWERS, "acc_50")  # 0.8 and 0.6, not 0.3
    assert scene_value(LERF_OPENGAUSSIAN, half) == pytest.approx(2 / 3)


def test_rows_carry_the_protocols_name_and_metrics():
    rows = list(measure_masks(LERF_MASK, "ours", ANSWERS["1"], TRUTHS["1"]))
    assert {row.protocol for row in rows} == {"lerf-mask/gaussian-grouping@1"}
    assert {row.metric for row in rows} == set(LERF_MASK.metrics)


def test_prediction_of_another_size_is_refused():
    with pytest.raises(MisalignedArtifactError, match=r"of egg.*\n  expected  1 x 10\n  found     2 x 5"):
        list(measure_masks(LERF_MASK, "ours", {"egg": np.ones((2, 5), bool)}, {"egg": strip(0, 1)}))


@settings(max_examples=20, deadline=None)
@given(st.permutations(["1", "2"]), st.permutations(["apple", "egg"]))
def test_order_of_views_and_texts_does_not_matter(views, texts):
    truths = {view: {text: TRUTHS[view][text] for text in texts if text in TRUTHS[view]} for view in views}
    for card in (LERF_MASK, LERF_OPENGAUSSIAN):
        shuffled = scene_value(card, values_of(card, ANSWERS, truths=truths))
        # a sum in another order may differ in its last bit
        assert shuffled == pytest.approx(scene_value(card, values_of(card, ANSWERS)), rel=1e-14)


# --- 3D-OVS by argmax -----------------------------------------------------------------------------

FOUR = np.array([[[1, 1, 0, 0]], [[0, 0, 1, 0]], [[0, 0, 0, 1]]], dtype=bool)  # classes 0, 0, 1, 2


def test_class_maps_give_a_row_per_class_and_the_accuracy_of_the_view():
    similarity = np.array([[[0.9, 0.1, 0.2, 0.2]], [[0.3, 0.5, 0.4, 0.2]], [[0.1, 0.4, 0.3, 0.3]]])
    rows = list(measure_class_maps("ours", similarity, FOUR, ["a", "b", "c"]))
    assert [(row.query, row.metric, row.value, row.n) for row in rows] == [
        ("a", "iou", 0.5, 1),
        ("b", "iou", 0.5, 1),
        ("c", "iou", 1.0, 1),
        ("", "pixel_accuracy", 0.75, 4),
    ]
    ious = {("v", row.query): row.value for row in rows if row.metric == "iou"}
    assert scene_value(PROTOCOLS["3d-ovs/argmax@3"], ious) == pytest.approx(0.666667, abs=1e-6)


def test_view_without_class_maps_counts_zero():
    assert {row.value for row in measure_class_maps("ours", None, FOUR, ["a", "b", "c"])} == {0.0}


def test_class_maps_of_another_size_are_refused():
    with pytest.raises(MisalignedArtifactError, match=r"class maps"):
        list(measure_class_maps("ours", np.zeros((3, 2, 4)), FOUR, ["a", "b", "c"]))


# --- truth without levels -------------------------------------------------------------------------


def test_flat_truth_has_categories_and_no_levels():
    truth = ViewTruth.flat({"apple": strip(2, 4)})
    assert truth.queries == ()
    assert truth.categories[0].boxes_xyxy.tolist() == [[2, 0, 4, 0]]
    assert not any(truth.families())
    boxes = {"apple": np.array([[1, 0, 5, 0], [7, 0, 8, 0]])}
    assert ViewTruth.flat({"apple": strip(2, 4)}, boxes).categories[0].boxes_xyxy.shape == (2, 4)


def test_a_prediction_for_an_unknown_query_is_refused_with_the_nearest_name():
    truth, queries = np.ones((2, 2), bool), {"green apple", "jake"}
    message = r"'gren apple', which is not a query of this scene(.|\n)*rename it 'green apple'"
    with pytest.raises(MisalignedArtifactError, match=message):
        list(measure_masks(LERF_MASK, "m", {"gren apple": truth}, {"green apple": truth}, queries))
    # a text of the scene that this view does not show is not a mistake
    answers = {"jake": truth, "green apple": truth}
    rows = list(measure_masks(LERF_MASK, "m", answers, {"green apple": truth}, queries))
    assert {row.query for row in rows} == {"green apple"}
