"""Tables of points, seeds, consistency and frames, from rows small enough to add up by hand."""

from dataclasses import replace

import numpy as np
import pytest

from hilsplat.configuration import RunSettings
from hilsplat.datasets.classes.scannet200 import SCANNET200_INSTANCES
from hilsplat.evaluate.metrics.instances import match_instances
from hilsplat.evaluate.scores import write_instances, write_scores
from hilsplat.evaluate.tables.build import TABLES, published_values, run_table
from hilsplat.evaluate.tables.point_tables import bootstrap_mean
from tests.conftest import PROJECT
from tests.unit.evaluate.tables.test_tables import PUBLISHED, built, measured, score

MODE = "(points: nearest)"


def point_score(protocol, metric, value, **more):
    names = {"dataset": "synthetic-rooms", "query": "", "level": "", "view": ""}
    return score(metric, value, protocol=f"{protocol}@1 {MODE}", **{**names, **more})


def test_scannet_shows_all_sets_of_classes_in_one_row_and_instances_of_all_scans_together(tmp_path):
    scores = [
        point_score("scannet/opengaussian-19", "miou_present", 0.2, scene="room-1"),
        point_score("scannet/opengaussian-19", "miou_present", 0.4, scene="room-2"),
        point_score("scannet200/opengaussian", "macc_present", 0.1, scene="room-1"),
        *(
            replace(point_score("scannet200/benchmark", metric, 0.6, scene="room-1", query="chair"), n=10)
            for metric in ("class_iou", "class_accuracy")
        ),
    ]
    # one scan finds its only instance, the other misses it: precision 1 up to recall 1/2
    truth = np.full(100, 2001)
    ids = SCANNET200_INSTANCES.ids
    found = np.ones((1, 100), bool)
    matches = {
        "room-1": match_instances(truth, found, np.array([2]), np.array([0.5]), ids),
        "room-2": match_instances(truth, found[:0], np.zeros(0, int), np.zeros(0), ids),
    }
    key = ("default", "sam-tiny", "tree")
    keyed = {("synthetic-rooms", scene, *key): each for scene, each in matches.items()}
    write_instances(tmp_path / "scores.csv", keyed)
    rows, _ = built(tmp_path, "scannet", scores)
    row = measured(rows, method="hilsplat (tree)")
    assert (row["19 classes mIoU"], row["ScanNet200 mAcc"]) == ("30.00", "10.00")
    assert (row["ScanNet200 AP"], row["ScanNet200 AP@25"]) == ("50.00", "50.00")
    assert (row["ScanNet200 head AP"], row["ScanNet200 tail AP"]) == ("50.00", "")
    assert (row["ScanNet200 head mIoU"], row["ScanNet200 tail mIoU"]) == ("60.00", "")
    assert row["protocol"] == "points: nearest"


def test_replica_shows_scenes_and_their_mean(tmp_path):
    scores = [
        point_score("replica/per-scene", "miou_present", 0.2, scene="room-1"),
        point_score("replica/per-scene", "miou_present", 0.4, scene="room-2"),
    ]
    rows, _ = built(tmp_path, "replica", scores)
    row = measured(rows, method="hilsplat (tree)")
    assert (row["room-1 mIoU"], row["room-2 mIoU"], row["Mean mIoU"]) == ("20.00", "40.00", "30.00")


def test_waymo_pools_the_counts_of_all_scenes(tmp_path):
    scores = []
    for scene, hits, union in (("street-1", 1, 2), ("street-2", 8, 8)):
        for metric in ("class_iou", "class_accuracy"):
            row = point_score("waymo/segmentation", metric, hits / union, scene=scene, query="car")
            scores.append(replace(row, n=union, dataset="synthetic-streets"))
    rows, _ = built(tmp_path, "waymo", scores)
    row = measured(rows, method="hilsplat (tree)")
    # (1 + 8) / (2 + 8) for cars, and 21 absent classes that count 1
    assert row["mIoU, present classes"] == "90.00"
    assert row["mIoU"] == f"{100 * (21 + 0.9) / 22:.2f}"


def test_seeds_of_a_variant_are_one_row_with_mean_and_spread(tmp_path):
    scores = [
        score("iou", value, variant=variant, method="field")
        for variant, value in (("default", 0.4), ("default.seed1", 0.5), ("default.seed2", 0.6))
    ]
    rows, forms = built(tmp_path, "hierarchy", scores)
    row = measured(rows, method="hilsplat (field)")
    assert (row["L1"], row["seeds"], row["Pairs"]) == ("50.00 ± 10.00", "3", "1")
    assert "50.0 ± 10.0" in forms[".md"]
    assert r"50.0 $\pm$ 10.0" in forms[".tex"]
    assert "standard deviation over seeds" in forms[".md"]


def test_annotations_are_one_unranked_row_whatever_the_variants_and_seeds(tmp_path):
    scores = [
        score("hc_containment", 1.0, variant=variant, method="truth", protocol="hierarchy/annotations@1")
        for variant in ("default", "paper", "paper.seed1", "paper.seed2")
    ]
    _, forms = built(tmp_path, "hierarchy", [*scores, score("hc_containment", 0.5, query="", level="")])
    lines = [line for line in forms[".md"].splitlines() if line.startswith("| annotations")]
    assert lines == ["| annotations | - | reference | 100.0 |"]


def test_view_consistency_is_shown_beside_the_level_given_rows(tmp_path):
    scores = [
        score("iou", 0.5),
        score("iou", 0.5, protocol="hierarchy/level-auto@6"),
        score("view_consistency", 0.8, protocol="world/view-consistency@2"),
        score("view_consistency", 0.6, protocol="world/view-consistency@2", query="mug"),
        score("view_consistency", 0.1, protocol="world/view-consistency@2", level="part"),
    ]
    rows, _ = built(tmp_path, "hierarchy", scores)
    assert measured(rows, protocol="level given")["View consistency"] == "40.00"  # (0.7 + 0.1) / 2
    assert measured(rows, protocol="level chosen")["View consistency"] == ""


def test_frames_are_the_views_that_were_asked_at_levels(tmp_path):
    scores = [
        score("iou", 0.5, view="007.png"),
        score("iou", 0.5, view="007.png", query="mug"),
        score("iou", 0.5, view="015.png"),
        score("iou", 0.5, view="015.png", method="field"),
    ]
    rows, _ = built(tmp_path, "frames-hi-lerf", scores)
    assert [row["one"] for row in rows if row["kind"] != "reported"] == ["007 (2 texts)", "015 (1 texts)"]
    assert [row["Figurines"] for row in rows if row["kind"] == "reported"][:2] == [
        "frame_00016",
        "frame_00041",
    ]


def test_scenes_without_labels_leave_the_reported_rows(tmp_path):
    rows, _ = built(tmp_path, "hierarchy", scores=[])
    assert {row["kind"] for row in rows} == {"reported"}


@pytest.mark.parametrize("name", sorted(TABLES))
def test_every_table_is_built_without_scores_and_lists_below_what_was_not_measured(tmp_path, name):
    assert TABLES[name].variants in RunSettings.model_fields
    out = tmp_path / f"{name}.csv"
    absent = ["replica (room_0): data_root is not set."]
    run_table(name, [], PROJECT / published_values(name), {}, out, absent)
    assert {line.partition(",")[0] for line in out.read_text().splitlines()[1:]} <= {"reported"}
    for suffix in (".md", ".tex", ".html"):
        assert "Not measured: replica (room" in out.with_suffix(suffix).read_text().replace(r"\_", "_")


def test_lerf_mask_means_go_over_texts_and_not_over_pairs(tmp_path):
    protocol = "lerf-mask/gaussian-grouping@1 (wholes)"
    scores = [
        score("iou", 0.8, query="apple", view="a", protocol=protocol, level=""),
        score("iou", 0.6, query="apple", view="b", protocol=protocol, level=""),
        score("iou", 0.3, query="egg", view="a", protocol=protocol, level=""),
    ]
    rows, _ = built(tmp_path, "lerf", scores)
    assert measured(rows, protocol=protocol)["Average mIoU"] == "50.00"  # pairs would give 56.67


def test_names_from_a_configuration_are_text_in_every_format(tmp_path):
    hostile = "<script>alert(1)</script> [x](javascript:alert(1)) a|b\nc"
    scores = tmp_path / "scores.csv"
    write_scores(scores, [score("iou", 0.5)])
    out = tmp_path / "hierarchy.csv"
    run_table("hierarchy", [scores], PUBLISHED / "hierarchy.csv", {"default": hostile}, out, [hostile])
    for suffix in (".md", ".html"):
        text = out.with_suffix(suffix).read_text()
        assert "alert(1)" in text
        assert "<script" not in text
    assert "](java" not in out.with_suffix(".md").read_text()


def test_intervals_widen_with_fewer_scenes_and_names():
    # half of the names are found: the mean is 0.5, and its interval shrinks as names are added
    def interval(scenes, names, pooled=False):
        hits = np.tile(np.arange(names) % 2 * 10.0, (scenes, 1))
        return bootstrap_mean(hits, np.full_like(hits, 10), np.ones(hits.shape, bool), pooled)

    few, many = interval(1, 6), interval(8, 40)
    assert few[0] < many[0] < 0.5 < many[1] < few[1]
    assert many[1] - many[0] < 0.2 < few[1] - few[0]
    assert interval(8, 40) == many
    low, high = interval(8, 40, pooled=True)  # the same names in every scene: no better known than from one
    assert high - low > many[1] - many[0]


def test_point_tables_show_intervals_and_the_number_of_names(tmp_path):
    scores = [
        replace(point_score("waymo/segmentation", metric, value, scene="street-1", query=name), n=100)
        for name, value in (("car", 1.0), ("pedestrian", 0.0), ("bus", 1.0), ("truck", 0.0))
        for metric in ("class_iou", "class_accuracy")
    ]
    rows, _ = built(tmp_path, "waymo", [replace(each, dataset="synthetic-streets") for each in scores])
    row = measured(rows, method="hilsplat (tree)")
    assert (row["mIoU, present classes"], row["Present classes 95 %"]) == ("50.00", "0 to 100")
