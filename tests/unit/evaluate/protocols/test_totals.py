"""Averages of rows in a table: every averaging order by hand."""

import math
from collections.abc import Mapping

import pandas as pd
import pytest

from hilsplat.evaluate.protocols.cards import CARDS, LERF_LANGSPLAT, LERF_MASK, LEVEL_GIVEN, OVS_ARGMAX
from hilsplat.evaluate.tables.measured import level_averages_of_scenes, scene_values, table_value


def rows_of(card, values, metric="iou", **more):
    """Rows of scores from (scene, view, query, value), or of one scene from (view, query) -> value."""
    if isinstance(values, Mapping):
        values = [("one", view, query, value) for (view, query), value in values.items()]
    frame = pd.DataFrame(values, columns=["scene", "view", "query", "value"])
    return frame.assign(**{"metric": metric, "protocol": card.full_name, "level": "", **more})


PAIRS = {("f1", "apple"): 0.8, ("f1", "egg"): 0.3, ("f2", "apple"): 0.6}


@pytest.mark.parametrize(("card", "first"), [(LERF_LANGSPLAT, 0.4), (LERF_MASK, (0.3 + 0.6) / 2)])
@pytest.mark.parametrize("departures", ["", " (filter 20)"])
def test_pairs_or_classes_of_a_scene_weigh_equally_and_so_do_scenes(card, first, departures):
    one = [("one", "f1", "a", 0.2), ("one", "f2", "a", 0.4), ("one", "f1", "b", 0.6)]
    rows = rows_of(card, [*one, ("two", "f", "a", 0.1)], protocol=card.full_name + departures)
    assert scene_values(rows, "iou").to_dict() == pytest.approx({"one": first, "two": 0.1})
    assert table_value(rows, "iou") == pytest.approx((first + 0.1) / 2)


def test_other_metrics_and_levels_are_ignored():
    rows = pd.concat(
        [
            rows_of(LEVEL_GIVEN, PAIRS, level="whole"),
            rows_of(LEVEL_GIVEN, {("f1", "lid"): 0.1}, level="part"),
            rows_of(LEVEL_GIVEN, {("f1", "apple"): 0.9}, "boundary_iou", level="whole"),
        ]
    )
    assert table_value(rows, "iou") == pytest.approx(1.8 / 4)
    assert table_value(rows, "iou", "part") == pytest.approx(0.1)
    assert math.isnan(table_value(rows, "iou", "subpart"))
    assert math.isnan(table_value(rows, "localization_box"))
    assert math.isnan(table_value(rows[:0], "iou"))


def test_scenes_are_paired_by_their_levels_over_all_seeds():
    # seed 0: whole 0.4 and 0.6, part 0.1; seed 1: whole 0.9 alone
    rows = pd.concat(
        [
            rows_of(LEVEL_GIVEN, {("f", "a"): 0.4, ("f", "b"): 0.6}, level="whole", seed="0"),
            rows_of(LEVEL_GIVEN, {("f", "c"): 0.1}, level="part", seed="0"),
            rows_of(LEVEL_GIVEN, {("f", "a"): 0.9}, level="whole", seed="1"),
        ]
    )
    expected = ((0.5 + 0.1) / 2 + 0.9) / 2
    assert level_averages_of_scenes(rows, "iou").to_dict() == pytest.approx({"one": expected})


def test_orders_are_not_mixed_and_pooled_protocols_have_no_number_per_scene():
    both = pd.concat([rows_of(LERF_MASK, PAIRS), rows_of(OVS_ARGMAX, PAIRS)])
    with pytest.raises(AssertionError, match="several averaging orders"):
        table_value(both, "iou")
    for card in CARDS:
        if card.averaging == "pooled":
            with pytest.raises(AssertionError, match="pooled"):
                table_value(rows_of(card, PAIRS), "iou")
