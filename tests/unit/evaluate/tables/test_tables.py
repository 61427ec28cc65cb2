"""Tables from rows small enough to add up by hand, and the paper's values as transcribed."""

import csv
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import yaml

from hilsplat.base.errors import ArtifactError
from hilsplat.configuration import RunSettings
from hilsplat.datasets.classes import SCANNET200_INSTANCES
from hilsplat.evaluate.metrics.instances import match_instances
from hilsplat.evaluate.protocols.cards import INSTANCES, LERF_MASK, OVS_ARGMAX
from hilsplat.evaluate.scores import write_instances, write_scores
from hilsplat.evaluate.tables.build import TABLES, published_values, run_table
from hilsplat.evaluate.tables.formats import latex_text
from hilsplat.evaluate.tables.image_tables import mean_difference
from hilsplat.evaluate.tables.measured import table_value
from hilsplat.evaluate.tables.point_tables import bootstrap_mean
from hilsplat.evaluate.tables.rows import Block, Cell, Row, read_published
from tests.conftest import PROJECT
from tests.unit.evaluate.builders import score

PUBLISHED = PROJECT / "config" / "published"

LERF, LEVELS = {"protocol": "lerf/tree-nodes@6", "level": ""}, "hierarchy/level-given@6"
SCORES = [
    # scene one: L1 0.8 and 0.6, L2 0.5, L3 0.2, 0.0, 0.1; scene two: L1 0.3 only
    score("iou", 0.8, query="a"),
    score("iou", 0.6, query="b"),
    score("iou", 0.5, query="c", level="part"),
    score("iou", 0.2, query="d", level="subpart"),
    score("iou", 0.0, query="e", level="subpart"),
    score("iou", 0.1, query="f", level="subpart"),
    score("iou", 0.3, query="g", scene="two"),
    score("hc_containment", 0.9, query="", level=""),
    score("hc_containment", 0.7, query="", level="", view="w.png"),
    score("hc_containment", 0.4, query="", level="", scene="two"),
    score("iou", 0.4, method="field"),
    score("hc_containment", 1.0, method="truth", protocol="hierarchy/annotations@1", query="", level=""),
    # the LERF protocol
    score("iou", 0.5, **LERF),
    score("boundary_iou", 0.25, **LERF),
    score("localization_box", 1.0, **LERF),
    score("localization_box", 0.0, **LERF, query="d"),
    score("iou", 0.7, **LERF, scene="two"),
    # another variant
    score("iou", 0.9, variant="omega-2", method="field"),
]


def built(tmp_path, name, scores=SCORES, labels=None, absent=()):
    """Rows of the CSV, and the other forms as text."""
    tmp_path.mkdir(exist_ok=True)
    write_scores(tmp_path / "scores.csv", scores)
    out = tmp_path / f"{name}.csv"
    files = [tmp_path / "scores.csv"] if scores else []
    run_table(name, files, PROJECT / published_values(name), labels or {}, out, absent)
    with out.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return rows, {suffix: out.with_suffix(suffix).read_text() for suffix in (".md", ".tex", ".html")}


def measured(rows, method="hilsplat (tree)", **names):
    """The measured row with these names."""
    names = {**names, "method": method}
    found = [row for row in rows if row["kind"] != "reported" and names.items() <= row.items()]
    assert len(found) == 1, found
    return found[0]


def cells(row, *names):
    return [row[name] for name in names]


@pytest.mark.parametrize("departures", ["", " (regions from 30 px)"])
def test_hierarchy_means_go_over_pairs_then_scenes_then_levels(tmp_path, departures):
    scores = [replace(row, protocol=row.protocol + departures) for row in SCORES]
    rows, forms = built(tmp_path, "hierarchy", scores)
    row = measured(rows, protocol=f"level given{departures}")
    # L1: (0.7 + 0.3) / 2, L2: 0.5, L3: 0.1; Avg (0.5 + 0.5 + 0.1) / 3; HC: (0.8 + 0.4) / 2
    found = cells(row, "L1", "L2", "L3", "Avg", "HC containment")
    assert found == ["50.00", "50.00", "10.00", "36.67", "60.00"]
    # above 0.25: three of six in scene one, one of one in scene two
    assert cells(row, "Acc@0.25", "Pairs") == ["75.00", "7"]
    assert cells(row, "kind", "data", "masks") == ["synthetic stand-in", "synthetic", "sam-tiny"]
    row = measured(rows, method="hilsplat (field)")  # levels without pairs stay out of the average
    assert cells(row, "L1", "L2", "L3", "Avg") == ["40.00", "", "", "40.00"]
    # kinds of rows are never mixed in a block
    assert {row["kind"] for row in rows} == {"reported", "synthetic stand-in"}
    headings = [line for line in forms[".md"].splitlines() if line.startswith("## ")]
    assert headings == [
        "## Reported in the paper: Hi-LERF",
        "## Reported in the paper: Hi-3DOVS",
        "## Measured on a synthetic stand-in (generated tabletops); not comparable",
    ]
    assert "not comparable with reported" in forms[".md"]


def test_lerf_table_has_a_column_per_scene_and_the_mean_of_scenes(tmp_path):
    rows, forms = built(tmp_path, "lerf", labels={"default": "ours"})
    row = measured(rows, method="ours (tree)", protocol="lerf/tree-nodes@6")
    assert cells(row, "one mIoU", "two mIoU", "Average mIoU") == ["50.00", "70.00", "60.00"]
    assert cells(row, "one mBIoU", "Average mBIoU", "Average localization") == ["25.00", "25.00", "50.00"]
    for entry in read_published(PUBLISHED / "lerf.csv"):
        assert entry["value"] in forms[".tex"] and entry["value"] in forms[".html"]
    assert forms[".tex"].count(r"\toprule") == forms[".tex"].count(r"\bottomrule") == 2
    assert forms[".html"].count("<table>") == forms[".html"].count("</table>") == 2
    assert "The printed scenes average to 70.7." in forms[".md"] and "<sup>" in forms[".html"]
    assert latex_text("50 % of a_b & c > d") == r"50 \% of a\_b \& c \textgreater{} d"


@pytest.mark.parametrize("departures", ["", " (filter 20)"])
def test_lerf_mask_means_go_over_texts_and_rows_of_a_published_data_set_are_measured(tmp_path, departures):
    values = ("apple", "a", 0.8), ("apple", "b", 0.6), ("egg", "a", 0.3)
    protocol = f"lerf-mask/gaussian-grouping@1{departures}"
    of_mask = {"dataset": "lerf_mask", "protocol": protocol, "level": ""}
    scores = [score("iou", value, query=query, view=view, **of_mask) for query, view, value in values]
    rows, forms = built(tmp_path, "lerf", scores)
    row = measured(rows)
    assert cells(row, "kind", "Average mIoU") == ["measured", "50.00"]  # pairs would give 56.67
    assert "## Measured on lerf_mask" in forms[".md"] and "synthetic" not in forms[".md"]


def test_a_scene_has_one_column_and_rows_over_part_of_the_scenes_say_so(tmp_path):
    names = {**LERF, "dataset": "lerf_ovs"}
    scenes = ("figurines", "ramen", "teatime", "waldo_kitchen")
    scores = [score("iou", 0.5, scene=scene, **names) for scene in scenes]
    scores.append(score("iou", 0.9, scene="waldo_kitchen", variant="half", method="field", **names))
    rows, forms = built(tmp_path, "lerf", scores)
    assert {row["Waldo kitchen mIoU"] for row in rows} >= {"37.9", "50.00", "90.00"}  # the paper's and ours
    assert "waldo_kitchen mIoU" not in rows[0]
    assert (measured(rows)["scenes"], measured(rows, method="half")["scenes"]) == ("", "1 of 4")
    assert "not all of them" in forms[".md"] and '<td class="name">1 of 4</td>' in forms[".html"]
    half = next(line for line in forms[".md"].splitlines() if line.startswith("| half"))
    assert half.count("90.0") == 2 and half.count("**90.0**") == 1  # best in its scene, not on average


def test_only_rows_of_comparable_protocols_are_ranked_together(tmp_path):
    """Values in % of the rows in bold: fields and trees, other rules for maps, masks of files."""
    values = {
        "lerf/langsplat@3": (("field", 0.41, "default"), ("field", 0.42, "other")),
        "lerf/tree-nodes@6": (("tree", 0.43, "default"),),
        "lerf/paper-mean@3": (("field", 0.51, "default"), ("field", 0.52, "other")),
        "lerf/langsplat@3 (filter 20)": (("field", 0.61, "default"),),
        "lerf/langsplat@3 (masks of files)": (("files", 0.71, "a"), ("files", 0.72, "b")),
        "lerf/paper-mean@3 (masks of files)": (("files", 0.71, "a"), ("files", 0.72, "b")),
    }
    scores = [
        score("iou", value, protocol=protocol, method=method, variant=variant, level="")
        for protocol, rows in values.items()
        for method, value, variant in rows
    ]
    _, forms = built(tmp_path, "lerf", scores)
    (*_, block) = forms[".md"].split("## ")
    assert sorted(re.findall(r"\*\*(\d\d)\.0\*\* \|$", block, re.MULTILINE)) == ["43", "52", "72", "72"]


def test_seeds_of_some_scenes_do_not_change_the_mean_over_all(tmp_path):
    scores = [score("iou", 0.3, scene=scene, variant="v", method="field", **LERF) for scene in "abcd"]
    scores.append(score("iou", 0.9, scene="a", variant="v.seed1", method="field", **LERF))
    rows, _ = built(tmp_path, "lerf", scores)
    assert measured(rows, method="v")["Average mIoU"] == "30.00"


def test_the_average_of_3d_ovs_is_over_the_scenes_of_the_paper(tmp_path):
    names = {"dataset": "3d_ovs", "protocol": "3d-ovs/langsplat@2", "level": ""}
    scores = [score("iou", 0.5, scene=scene, **names) for scene in ("bed", "bench", "room", "sofa", "lawn")]
    rows, _ = built(tmp_path / "all", "3dovs", [*scores, score("iou", 0.9, scene="snacks", **names)])
    assert "scenes" not in rows[0] and measured(rows)["Overall mIoU"] == "50.00"
    rows, _ = built(tmp_path / "part", "3dovs", scores[:3])
    assert measured(rows)["scenes"] == "3 of 5"


def test_ablation_rows_take_localization_from_the_flat_protocol(tmp_path):
    rows, _ = built(tmp_path, "ablation", labels={"default": "hilsplat", "omega-2": "Omega 2"})
    row = measured(rows)
    assert cells(row, "LERF localization", "L1", "Hi-LERF HC") == ["50.00", "50.00", "60.00"]
    names = [row["method"] for row in rows if row["kind"] != "reported"]
    assert names == ["hilsplat (field)", "hilsplat (tree)", "Omega 2"]


def test_ablation_columns_average_the_scenes_of_their_own_tables(tmp_path):
    """Rows of Hi-LERF and Hi-3DOVS with columns of LERF and 3D-OVS; lawn is averaged, snacks isn't."""
    lerf, ovs = ("figurines", "ramen", "teatime", "waldo_kitchen"), ("bed", "bench", "room", "sofa", "lawn")

    def flat(data, protocol, values):
        names = {"dataset": data, "protocol": protocol, "level": ""}
        return [score("iou", value, scene=scene, **names) for scene, value in values.items()]

    of_lerf = flat("lerf_ovs", "lerf/tree-nodes@6", {**dict.fromkeys(lerf, 0.4), "ramen": 0.8})
    of_ovs = flat("3d_ovs", "3d-ovs/langsplat@2", {**dict.fromkeys(ovs, 0.5), "snacks": 0.9, "table": 0.9})
    of_hi = [score("iou", 0.6, scene=scene, dataset="hi_lerf") for scene in lerf]
    of_hi_ovs = [score("iou", 0.6, scene=scene, dataset="hi_3dovs") for scene in ("bed", "snacks")]

    def columns(name, scores):
        rows, _ = built(tmp_path / name, "ablation", scores)
        return {
            row["data"]: [row.get(name) for name in ("LERF mIoU", "3D-OVS mIoU", "scenes")]
            for row in rows
            if row["kind"] == "measured"
        }

    every = [*of_lerf, *of_ovs, *of_hi, *of_hi_ovs]
    assert columns("all", every) == {
        "hi_lerf": ["50.00", "50.00", ""],
        "hi_3dovs": ["50.00", "50.00", "2 of 10"],
    }
    # a row over one scene of LERF, and scores without lawn
    part = [*of_lerf, *of_ovs[:4], *of_hi[1:2], *of_hi_ovs]
    assert columns("part", part) == {
        "hi_lerf": ["80.00", "", "1 of 4"],
        "hi_3dovs": ["50.00", "50.00", "2 of 10"],
    }
    less = columns("less", [*of_lerf[:3], *of_hi, *of_hi_ovs])
    assert [row[0] for row in less.values()] == [None, None]


def ablation_of(tmp_path, values):
    """The measured rows of an ablation by name, and its Markdown; values by scene, level and variant."""
    scores = [
        score("iou", value, variant=variant, method="field", scene=scene, level=level)
        for (scene, level), of_variants in values.items()
        for variant, value in of_variants.items()
    ]
    rows, forms = built(tmp_path, "ablation", scores, {"paper-hc": "3D-HC"})
    steps = {row["method"]: (row["step from"], row["mIoU step"]) for row in rows if row["kind"] != "reported"}
    return steps, forms[".md"]


def test_ablation_rows_are_compared_with_the_default_field_scene_by_scene(tmp_path):
    values = {
        ("one", "whole"): {"default": 0.4, "d-8": 0.5, "d-8.seed1": 0.7, "other": 0.2},
        ("one", "part"): {"default": 0.2, "d-8": 0.3},
        ("two", "whole"): {"default": 0.8, "d-8": 0.7, "d-8.seed1": 0.9},
    }
    steps, text = ablation_of(tmp_path, values)
    # levels, then seeds. Scene one: (0.4 + 0.7) / 2 - 0.3 = 0.25; scene two: (0.7 + 0.9) / 2 - 0.8 = 0
    ours = "hilsplat (field)"
    assert steps == {ours: ("", ""), "d-8": (ours, "12.50 ± 12.50"), "other": (ours, "-10.00")}
    assert "+12.5 ± 12.5" in text


def test_rows_of_the_ladder_are_compared_with_the_row_that_they_extend_by_scene_and_seed(tmp_path):
    variants = "paper-hc", "paper-hc.seed1", "paper-part", "paper-part.seed1"
    values = {"one": (0.4, 0.6, 0.5, 0.6), "two": (0.2, 0.8, 0.3, 0.8)}
    of_levels = {(name, "whole"): dict(zip(variants, of, strict=True)) for name, of in values.items()}
    steps, _ = ablation_of(tmp_path, of_levels)
    # differences of 0.1, 0, 0.1 and 0: mean 0.05, deviation 0.0577, error 0.0289
    assert steps == {"3D-HC": ("", ""), "paper-part": ("3D-HC", "5.00 ± 2.89")}
    assert mean_difference([-0.03, 0.02]).text == "+0.0 ± 0.0"


def test_steps_of_the_ladder_are_variants_of_the_configuration():
    variants = yaml.safe_load((PROJECT / "config/config.yaml").read_text())["variants"]
    steps = TABLES["ablation"].steps
    assert {*steps, *steps.values()} <= set(variants)


def test_averaging_orders_are_not_mixed_and_pooled_protocols_have_no_number_per_scene():
    pairs, classes, pooled = (card.full_name for card in (OVS_ARGMAX, LERF_MASK, INSTANCES))
    for protocols, message in (((pairs, classes), "several averaging orders"), ((pooled,), "pooled")):
        frame = pd.DataFrame({"protocol": protocols, "metric": "iou", "scene": "one", "value": 0.5})
        with pytest.raises(AssertionError, match=message):
            table_value(frame, "iou")


@pytest.mark.parametrize(
    ("column", "texts", "ranks"),
    [
        ("x", ["10.0", "30.0", "30.0", "20.0", "-", "25x3", "5.0"], {1: 1, 2: 1, 3: 2, 0: 3}),
        ("Query (s)", ["10.0", "30.0", "30.0", "20.0", "-", "25x3", "5.0"], {6: 1, 0: 2, 3: 3}),  # lowest
        ("x", ["10.0"], {}),  # a single row is not ranked
    ],
)
def test_best_three_share_ranks_when_equal(column, texts, ranks):
    rows = [Row({"Method": str(row)}, {column: Cell.printed(text)}) for row, text in enumerate(texts)]
    block = Block("reported", "d", "t", tuple(rows), (column,))
    assert block.ranks() == {(row, column): rank for row, rank in ranks.items()}


def test_names_are_text_in_every_format(tmp_path):
    hostile = "[x](javascript:alert(1)) <script>alert(1)</script> a|b\n\nc"
    scores = [score("iou", 0.5, scene=hostile, dataset=hostile, view=hostile, **LERF)]
    for name, own in (("lerf", scores), ("frames-hi-lerf", [replace(scores[0], protocol=LEVELS)])):
        _, forms = built(tmp_path, name, own, {"default": hostile}, [hostile])
        for suffix in (".md", ".html"):
            assert "alert(1)" in forms[suffix]
            assert "<script" not in forms[suffix]
        block = forms[".md"].rpartition("## ")[2].splitlines()
        assert "](java" not in forms[".md"]
        bars = {len(re.findall(r"(?<!\\)\|", line)) for line in block if line.startswith("|")}
        assert len(bars) == 1  # every row has the columns of the header
        # no arguments of a row's end, no paragraphs
        assert "\n[" not in forms[".tex"] and "\n\n" not in forms[".tex"]


def test_scenes_whose_names_differ_only_in_a_space_have_columns_of_their_own(tmp_path):
    scores = [score("iou", value, scene=scene, **LERF) for scene, value in (("desk1", 0.5), ("desk_1", 0.7))]
    row = measured(built(tmp_path, "lerf", scores)[0])
    assert cells(row, "desk1 mIoU", "desk_1 mIoU") == ["50.00", "70.00"]


def test_scores_that_belong_to_no_row_of_a_table_are_reported(tmp_path, caplog):
    built(tmp_path, "lerf", [score("iou", 0.7, **LERF)])
    assert "of table lerf" not in caplog.text
    built(tmp_path, "waymo", [score("iou", 0.7, **LERF)])
    assert "scores.csv is of table waymo" in caplog.text


def test_an_unknown_table_is_an_error_that_lists_the_tables(tmp_path):
    with pytest.raises(ArtifactError, match="one of lerf, 3dovs, replica"):
        run_table("leftovers", [], PUBLISHED / "lerf.csv", {}, tmp_path / "x.csv")


def test_tables_do_not_load_torch_or_opencv(tmp_path):
    scores = tmp_path / "scores.csv"
    write_scores(scores, [score("iou", 0.5, **LERF)])
    published, out = PUBLISHED / "lerf.csv", tmp_path / "l.csv"
    arguments = f"'lerf', [Path({str(scores)!r})], Path({str(published)!r}), {{}}, Path({str(out)!r})"
    code = (
        "import sys; from pathlib import Path; from hilsplat.evaluate.tables.build import run_table; "
        f"run_table({arguments}); "
        "print([name for name in ('torch', 'cv2', 'matplotlib', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", sorted(TABLES))
def test_every_table_is_built_without_scores_and_lists_what_was_not_measured(tmp_path, name):
    assert TABLES[name].variants in RunSettings.model_fields
    rows, forms = built(tmp_path, name, [], absent=["replica (room_0): data_root is not set."])
    assert {row["kind"] for row in rows} <= {"reported"}
    for text in forms.values():
        assert "Not measured: replica (room" in text.replace(r"\_", "_")


# --- points ----------------------------------------------------------------------------------------


def point_score(protocol, metric, value, n=1, **more):
    names = {"dataset": "synthetic-rooms", "scene": "room-1", "query": "", "level": "", "view": "", **more}
    return score(metric, value, protocol=f"{protocol}@1 (points: nearest)", n=n, **names)


def class_scores(protocol, value, n, **more):
    metrics = ("class_iou", "class_accuracy")
    return [point_score(protocol, metric, value, n, **more) for metric in metrics]


@pytest.mark.parametrize("variant", ["default", "default.seed01"])
def test_scannet_shows_all_sets_of_classes_in_one_row_and_instances_of_all_scans_together(tmp_path, variant):
    scores = [
        point_score("scannet/opengaussian-19", "miou_present", 0.2),
        point_score("scannet/opengaussian-19", "miou_present", 0.4, scene="room-2"),
        point_score("scannet200/opengaussian", "macc_present", 0.1),
        *class_scores("scannet200/benchmark", 0.6, 10, query="chair"),
    ]
    # one scan finds its only instance, the other misses it: precision 1 up to recall 1/2
    truth, ids, found = np.full(100, 2001), SCANNET200_INSTANCES.ids, np.ones((1, 100), bool)
    matches = {
        "room-1": match_instances(truth, found, np.array([2]), np.array([0.5]), ids),
        "room-2": match_instances(truth, found[:0], np.zeros(0, int), np.zeros(0), ids),
    }
    matches["frozen"] = matches["room-2"]
    keyed = {("synthetic-rooms", name, variant, "sam-tiny", "tree"): each for name, each in matches.items()}
    write_instances(tmp_path / "scores.csv", keyed)
    frozen = "scannet200/opengaussian@1 (points: frozen)"
    scores.append(replace(scores[2], scene="frozen", protocol=frozen))
    rows, _ = built(tmp_path, "scannet", [replace(row, variant=variant) for row in scores])
    assert measured(rows, protocol="points: frozen")["ScanNet200 AP"] == "0.00"
    row = measured(rows, protocol="points: nearest")
    assert cells(row, "19 classes mIoU", "ScanNet200 mAcc") == ["30.00", "10.00"]
    assert cells(row, *(f"ScanNet200 {name}" for name in ("AP", "AP@25", "head AP"))) == ["50.00"] * 3
    assert cells(row, "ScanNet200 head mIoU", "ScanNet200 tail mIoU") == ["60.00", ""]
    assert row["ScanNet200 tail AP"] == ""


def test_replica_shows_scenes_and_their_mean(tmp_path):
    values = {"room-1": 0.2, "room-2": 0.4}.items()
    scores = [point_score("replica/per-scene", "miou_present", value, scene=name) for name, value in values]
    row = measured(built(tmp_path, "replica", scores)[0])
    assert cells(row, "room-1 mIoU", "room-2 mIoU", "Mean mIoU") == ["20.00", "40.00", "30.00"]


def test_waymo_pools_the_counts_of_all_scenes(tmp_path):
    first = class_scores("waymo/segmentation", 1 / 2, 2, scene="street-1", query="car")
    second = class_scores("waymo/segmentation", 8 / 8, 8, scene="street-2", query="car")
    predicted = replace(second[0], query="bus", value=0.0)
    row = measured(built(tmp_path, "waymo", [*first, *second, predicted])[0])
    # (1 + 8) / (2 + 8) for cars, 0 for buses, which are not present, and 20 absent classes that count 1
    assert cells(row, "mIoU, present classes", "mIoU") == ["90.00", f"{100 * (20 + 0.9) / 22:.2f}"]
    assert row["Classes present"] == "1"
    others = {"pedestrian": 0.0, "bus": 1.0, "truck": 0.0, "car": 1.0}.items()
    scores = [
        row for name, value in others for row in class_scores("waymo/segmentation", value, 9, query=name)
    ]
    row = measured(built(tmp_path, "waymo", scores)[0])
    assert cells(row, "mIoU, present classes", "Present classes 95 %") == ["50.00", "0 to 100"]


@pytest.mark.parametrize(
    ("name", "protocol", "column"),
    [
        ("scannet", "scannet200/opengaussian", "ScanNet200 95 %"),
        ("replica", "replica/per-scene", "Mean 95 %"),
        ("waymo", "waymo/segmentation", "Present classes 95 %"),
    ],
)
def test_intervals_are_of_the_mean_over_seeds(tmp_path, name, protocol, column):
    # One name: its IoU is the mean in each resample. With 0.2 and 0.6, the mean over seeds is 0.4.
    query, values = "car" if name == "waymo" else "chair", {"v": 0.2, "v.seed1": 0.6}.items()
    scores = [
        row for variant, v in values for row in class_scores(protocol, v, 10, variant=variant, query=query)
    ]
    row = measured(built(tmp_path, name, scores)[0], method="v, tree")
    assert cells(row, column, "seeds") == ["40 to 40", "2"]


def test_intervals_widen_with_fewer_scenes_and_names():
    # half of the names are found: the mean is 0.5, and its interval shrinks as names are added
    def interval(scenes, names, pooled=False):
        hits = np.tile(np.arange(names) % 2 * 10.0, (1, scenes, 1))
        return bootstrap_mean(hits, np.full_like(hits, 10), np.ones((scenes, names), bool), pooled)

    few, many = interval(1, 6), interval(8, 40)
    assert few[0] < many[0] < 0.5 < many[1] < few[1]
    assert many[1] - many[0] < 0.2 < few[1] - few[0]
    assert interval(8, 40) == many
    low, high = interval(8, 40, pooled=True)  # the same names in every scene: no better known than from one
    assert high - low > many[1] - many[0]


# --- seeds, annotations, consistency, frames, true masks -------------------------------------------


def test_seeds_of_a_variant_are_one_row_with_mean_and_spread_of_what_all_have(tmp_path):
    values = {"default": 0.4, "default.seed1": 0.5, "default.seed2": 0.6}
    scores = [score("iou", value, variant=variant, method="field") for variant, value in values.items()]
    of_two = [replace(row, metric="hc_anchored", query="", level="") for row in scores[1:]]
    rows, forms = built(tmp_path, "hierarchy", [*scores, *of_two])
    row = measured(rows, method="hilsplat (field)")
    assert cells(row, "L1", "seeds", "Pairs", "HC anchored") == ["50.00 ± 10.00", "3", "1", ""]
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
    protocol = {"protocol": "world/view-consistency@2"}
    scores = [
        score("iou", 0.5),
        score("iou", 0.5, protocol="hierarchy/level-auto@7"),
        score("view_consistency", 0.8, **protocol),
        score("view_consistency", 0.6, query="mug", **protocol),
        score("view_consistency", 0.1, level="part", **protocol),
    ]
    rows, _ = built(tmp_path, "hierarchy", scores)
    assert measured(rows, protocol="level given")["View consistency"] == "40.00"  # (0.7 + 0.1) / 2
    assert measured(rows, protocol="level chosen")["View consistency"] == ""


def test_frames_are_the_views_that_were_queried_at_levels(tmp_path):
    views = [("007.png", "cup", "tree"), ("007.png", "mug", "tree"), ("015.png", "cup", "tree")]
    scores = [
        score("iou", 0.5, view=view, query=query, method=method)
        for view, query, method in [*views, ("015.png", "cup", "field")]
    ]
    rows, _ = built(tmp_path, "frames-hi-lerf", scores)
    assert [row["one"] for row in rows if row["kind"] != "reported"] == ["007 (2 texts)", "015 (1 text)"]
    assert rows[0]["Figurines"] == "frame_00016"  # reported in the paper


TRUE_MASKS = "truth-perturbed (merge 0.2)"


def test_a_row_with_true_masks_is_marked_and_not_ranked(tmp_path):
    labels = {"default": "hilsplat", "bad-masks": "hilsplat"}
    usual = [score("iou", 0.5), score("iou", 0.4, variant="omega-2")]
    _, forms = built(tmp_path, "hierarchy", usual, labels)
    assert "true masks" not in forms[".md"] and "true labels" not in forms[".md"]
    marked = score("iou", 0.9, masks=TRUE_MASKS, variant="bad-masks")
    rows, forms = built(tmp_path, "hierarchy", [*usual, marked], labels)
    assert [(row["method"], row["masks"]) for row in rows if row["kind"] != "reported"] == [
        ("hilsplat (tree)", "sam-tiny"),
        ("omega-2, tree", "sam-tiny"),
        ("diagnostic, true masks: hilsplat, tree", TRUE_MASKS),
    ]
    assert "They are not results" in forms[".md"]
    stand_in = forms[".md"].split("synthetic stand-in (generated")[1]
    assert "**50.0**" in stand_in
    assert " 90.0 " in stand_in and "**90.0**" not in stand_in


# --- the paper's values -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(TABLES))
def test_every_table_has_published_values_without_gaps(name):
    entries = read_published(PROJECT / published_values(name))
    by_family = {}
    for entry in entries:
        by_family.setdefault((entry["family"], entry["method"]), []).append(entry["column"])
        assert entry["value"] == "-" or entry["value"].removeprefix("frame_")[0].isdigit()
    columns = {}
    for found in by_family.values():
        assert len(found) == len(set(found))
        assert columns.setdefault("", found) == found


LERF_SCENES = ("Figurines", "Ramen", "Teatime", "Waldo kitchen")


@pytest.mark.parametrize(
    ("name", "average", "parts"),
    [
        ("hierarchy", "Hi-LERF Avg", [f"Hi-LERF L{level}" for level in (1, 2, 3)]),
        ("hierarchy", "Hi-3DOVS Avg", [f"Hi-3DOVS L{level}" for level in (1, 2, 3)]),
        ("lerf", "Average mIoU", [f"{scene} mIoU" for scene in LERF_SCENES]),
        ("lerf", "Average mBIoU", [f"{scene} mBIoU" for scene in LERF_SCENES]),
        ("lerf", "Average localization", [f"{scene} localization" for scene in LERF_SCENES]),
        ("3dovs", "Overall mIoU", [f"{scene} mIoU" for scene in ("Bed", "Bench", "Room", "Sofa", "Lawn")]),
    ],
)
def test_printed_averages_add_up_or_carry_a_note(name, average, parts):
    rows = {}
    for entry in read_published(PUBLISHED / f"{name}.csv"):
        rows.setdefault(entry["method"], {})[entry["column"]] = entry
    for cells in rows.values():
        values = [cells[column]["value"] for column in (average, *parts)]
        if "-" in values:
            continue
        printed, *of_parts = map(float, values)
        adds_up = abs(sum(of_parts) / len(of_parts) - printed) < 0.0502  # half of the last printed digit
        assert adds_up or "average to" in cells[average]["note"]
