"""Rows of points, pooled and per scene, and how predictions of Gaussians reach points."""

import numpy as np
import pytest

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.datasets.classes.class_set import ClassSet
from hilsplat.datasets.classes.scannet import SCANNET_10, SCANNET_19
from hilsplat.datasets.classes.scannet200 import SCANNET200, SCANNET200_INSTANCES, splits_of
from hilsplat.datasets.classes.waymo import WAYMO_22
from hilsplat.evaluate.metrics.instances import match_instances
from hilsplat.evaluate.protocols.cards import PROTOCOLS
from hilsplat.evaluate.protocols.points import measure_instances, measure_points, pooled_points
from hilsplat.evaluate.scores import read_scores, write_scores
from tests.unit.evaluate.builders import score

OPENGAUSSIAN = PROTOCOLS["scannet/opengaussian-19@1"]
WAYMO = PROTOCOLS["waymo/segmentation@1"]
TRUTH = np.array([1, 1, 1, 1, 2, 2, 3, 3, 0, 0])
PREDICTION = np.array([1, 1, 2, 4, 2, 2, 3, 1, 1, 2])


def test_rows_of_the_worked_example():
    rows = list(measure_points(OPENGAUSSIAN, "tree", TRUTH, PREDICTION, SCANNET_19, "frozen"))
    assert {row.protocol for row in rows} == {"scannet/opengaussian-19@1 (points: frozen)"}
    ious = {row.query: (row.value, row.n) for row in rows if row.metric == "class_iou"}
    # the first four of the 19: wall, floor, cabinet, bed
    assert ious == {
        "wall": (pytest.approx(2 / 5), 5),
        "floor": (pytest.approx(2 / 3), 3),
        "cabinet": (pytest.approx(1 / 2), 2),
        "bed": (0, 1),  # predicted only
    }
    accuracies = {row.query: (row.value, row.n) for row in rows if row.metric == "class_accuracy"}
    assert accuracies == {"wall": (0.5, 4), "floor": (1, 2), "cabinet": (0.5, 2)}
    means = {row.metric: row.value for row in rows if not row.query}
    assert means == {
        "miou_present": pytest.approx(0.522222, abs=1e-6),
        "macc_present": pytest.approx(0.666667, abs=1e-6),
    }


def test_missed_points_count_zero_and_a_scene_without_truth_has_no_rows():
    nothing = np.zeros(10, dtype=int)
    rows = list(measure_points(OPENGAUSSIAN, "tree", TRUTH, nothing, SCANNET_19, "frozen"))
    assert {row.value for row in rows} == {0.0}
    assert {row.query for row in rows} == {"", "wall", "floor", "cabinet"}
    assert list(measure_points(OPENGAUSSIAN, "tree", nothing, PREDICTION, SCANNET_19, "frozen")) == []


def test_pooled_rows_equal_points_put_together_also_after_a_file(tmp_path):
    rng = np.random.default_rng(0)
    scenes = [(rng.integers(0, 6, 997), rng.integers(0, 6, 997)) for _ in range(3)]
    rows = [list(measure_points(WAYMO, "tree", *scene, WAYMO_22, "nearest")) for scene in scenes]
    assert all(row.query for each in rows for row in each)  # no number per scene
    together = np.concatenate(scenes, axis=1)
    expected = pooled_points(WAYMO, [measure_points(WAYMO, "t", *together, WAYMO_22, "x")], WAYMO_22)
    assert pooled_points(WAYMO, rows, WAYMO_22) == expected
    for number, each in enumerate(rows):
        write_scores(tmp_path / f"{number}.csv", [score(**vars(row), view="") for row in each])
    read = [read_scores([tmp_path / f"{number}.csv"]).itertuples() for number in range(3)]
    assert pooled_points(WAYMO, read, WAYMO_22) == expected
    # five of 22 classes occur; the other 17 count 1 under Waymo's own mean
    assert expected["miou_absent_as_one"] == pytest.approx((5 * expected["miou_present"] + 17) / 22)


def test_scannet200_is_split_into_head_common_and_tail():
    card = PROTOCOLS["scannet200/benchmark@1"]
    places = [members.index(True) + 1 for members in splits_of(SCANNET200).values()]
    truth = np.repeat(places, 2)
    prediction = truth * np.array([1, 1, 1, 0, 0, 0])  # head right, common half, tail missed
    rows = list(measure_points(card, "tree", truth, prediction, SCANNET200, "nearest"))
    assert pooled_points(card, [rows], SCANNET200) == {
        "miou_occurring": 0.5,
        "miou_head": 1.0,
        "miou_common": 0.5,
        "miou_tail": 0.0,
    }


def test_other_classes_and_other_points_are_refused():
    with pytest.raises(MisalignedArtifactError, match=r"expected  scannet-19\n  found     scannet-10"):
        list(measure_points(OPENGAUSSIAN, "tree", TRUTH, PREDICTION, SCANNET_10, "frozen"))
    with pytest.raises(MisalignedArtifactError, match=r"expected  10 points\n  found     9"):
        list(measure_points(OPENGAUSSIAN, "tree", TRUTH, PREDICTION[:9], SCANNET_19, "frozen"))


def test_class_sets_turn_file_labels_into_rows():
    classes = ClassSet("c", "here", (7, 3, 1191), ("a", "b", "c"))
    found = classes.labels(np.array([3, 7, 1191, 5, 0, -2, 2000]))
    assert found.tolist() == [2, 1, 3, 0, 0, 0, 0]


def test_instance_rows_are_of_all_scans_together():
    truth = np.repeat([4001, 0], 4)
    mask = np.repeat([[True, False]], 4, axis=1)
    found = (truth, mask, np.array([4]), np.ones(1))
    missed = (truth, mask[:0], np.zeros(0, int), np.zeros(0))
    ids = SCANNET200_INSTANCES.ids
    scans = {"a": match_instances(*found, ids, 1), "b": match_instances(*missed, ids, 1)}
    rows = list(measure_instances("tree", scans, "nearest"))
    assert {row.n for row in rows} == {2}
    values = {row.metric: row.value for row in rows}
    none = pytest.approx(np.nan, nan_ok=True)  # 4 is a class of the head
    half = dict.fromkeys(("ap", "ap50", "ap25", "ap_head"), pytest.approx(0.5))
    assert values == {**half, "ap_common": none, "ap_tail": none}
    assert rows[0].protocol == "scannet200/instances@1 (points: nearest)"
    nothing = {"a": match_instances(*found, ids[5:], 1)}
    assert list(measure_instances("tree", nothing, "nearest")) == []
