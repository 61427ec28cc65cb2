"""Tables from rows small enough to add up by hand, and the paper's values as transcribed."""

import csv
import subprocess
import sys

import pytest

from hilsplat.base.errors import ArtifactError
from hilsplat.evaluate.scores import Score, write_scores
from hilsplat.evaluate.tables.build import TABLES, published_values, run_table
from hilsplat.evaluate.tables.formats import latex_text
from hilsplat.evaluate.tables.rows import Block, Cell, Row
from hilsplat.evaluate.tables.sources import read_published
from tests.conftest import PROJECT

PUBLISHED = PROJECT / "config" / "published"


def score(metric, value, *, scene="one", variant="default", method="tree", protocol=None, **more):
    fields = {"dataset": "synthetic", "view": "v.png", "query": "cup", "level": "whole", "masks": "sam-tiny"}
    protocol = protocol or "hierarchy/level-given@5"
    return Score(
        **{**fields, **more},
        scene=scene,
        variant=variant,
        method=method,
        metric=metric,
        protocol=protocol,
        value=value,
        n=1,
    )


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
    score("iou", 0.5, protocol="lerf/tree-nodes@5", level=""),
    score("boundary_iou", 0.25, protocol="lerf/tree-nodes@5", level=""),
    score("localization_box", 1.0, protocol="lerf/tree-nodes@5", level=""),
    score("localization_box", 0.0, protocol="lerf/tree-nodes@5", level="", query="d"),
    score("iou", 0.7, protocol="lerf/tree-nodes@5", level="", scene="two"),
    # another variant
    score("iou", 0.9, variant="omega-2", method="field"),
]


def built(tmp_path, name, scores=SCORES, labels=None):
    """Rows of the CSV, and the other forms as text."""
    write_scores(tmp_path / "scores.csv", scores)
    out = tmp_path / f"{name}.csv"
    run_table(name, [tmp_path / "scores.csv"], PUBLISHED / f"{name}.csv", labels or {}, out)
    with out.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return rows, {suffix: out.with_suffix(suffix).read_text() for suffix in (".md", ".tex", ".html")}


def measured(rows, **names):
    found = [row for row in rows if row["kind"] != "reported"]
    for name, value in names.items():
        found = [row for row in found if row[name] == value]
    assert len(found) == 1, found
    return found[0]


def test_hierarchy_means_go_over_pairs_then_scenes_then_levels(tmp_path):
    rows, _ = built(tmp_path, "hierarchy")
    row = measured(rows, method="hilsplat (tree)", protocol="level given")
    # L1: (0.7 + 0.3) / 2, L2: 0.5, L3: 0.1; Avg (0.5 + 0.5 + 0.1) / 3; HC: (0.8 + 0.4) / 2
    assert [row[name] for name in ("L1", "L2", "L3", "Avg", "HC containment")] == [
        "50.00",
        "50.00",
        "10.00",
        "36.67",
        "60.00",
    ]
    # above 0.25: three of six in scene one, one of one in scene two
    assert row["Acc@0.25"] == "75.00"
    assert row["Pairs"] == "7"
    assert (row["kind"], row["data"], row["masks"]) == ("synthetic stand-in", "synthetic", "sam-tiny")
    row = measured(rows, method="hilsplat (field)")  # levels without pairs stay out of the average
    assert (row["L1"], row["L2"], row["L3"], row["Avg"]) == ("40.00", "", "", "40.00")


def test_kinds_are_never_mixed_in_a_block(tmp_path):
    rows, forms = built(tmp_path, "hierarchy")
    assert {row["kind"] for row in rows} == {"reported", "synthetic stand-in"}
    headings = [line for line in forms[".md"].splitlines() if line.startswith("## ")]
    assert headings == [
        "## Reported in the paper: Hi-LERF",
        "## Reported in the paper: Hi-3DOVS",
        "## Measured on a synthetic stand-in (tables of the synthetic world); not comparable",
    ]
    assert "not comparable with reported" in forms[".md"]


def test_rows_of_a_real_data_set_are_measured_rows(tmp_path):
    scores = [score("iou", 0.5, dataset="lerf", protocol="lerf/langsplat@2", method="field", level="")]
    rows, forms = built(tmp_path, "lerf", scores)
    assert measured(rows, data="lerf")["kind"] == "measured"
    assert "## Measured on lerf" in forms[".md"]
    assert "synthetic" not in forms[".md"]


def test_lerf_table_has_a_column_per_scene_and_the_mean_of_scenes(tmp_path):
    rows, _ = built(tmp_path, "lerf", labels={"default": "ours"})
    row = measured(rows, method="ours (tree)", protocol="lerf/tree-nodes@5")
    assert (row["one mIoU"], row["two mIoU"], row["Average mIoU"]) == ("50.00", "70.00", "60.00")
    assert (row["one mBIoU"], row["Average mBIoU"]) == ("25.00", "25.00")
    assert row["Average localization"] == "50.00"


def test_ablation_rows_take_localization_from_the_flat_protocol(tmp_path):
    labels = {"default": "hilsplat", "omega-2": "Omega 2"}
    rows, _ = built(tmp_path, "ablation", labels=labels)
    row = measured(rows, method="hilsplat (tree)")
    assert (row["LERF localization"], row["L1"], row["Hi-LERF HC"]) == ("50.00", "50.00", "60.00")
    names = [row["method"] for row in rows if row["kind"] != "reported"]
    assert names == ["hilsplat (field)", "hilsplat (tree)", "Omega 2"]


def test_ablation_rows_are_held_against_the_default_field_scene_by_scene(tmp_path):
    values = {"default": (0.4, 0.8), "d-8": (0.5, 0.7), "d-8.seed1": (0.7, 0.9), "paper": (0.3, None)}
    scores = [
        score("iou", value, variant=variant, method="field", scene=scene)
        for variant, of_scenes in values.items()
        for scene, value in zip(("one", "two"), of_scenes, strict=True)
        if value is not None
    ]
    rows, forms = built(tmp_path, "ablation", scores)
    differences = {row["method"]: row["against default field"] for row in rows if row["kind"] != "reported"}
    # scene one: (0.5 + 0.7) / 2 - 0.4 = 0.2; scene two: (0.7 + 0.9) / 2 - 0.8 = 0
    assert differences == {"hilsplat (field)": "", "d-8": "10.00 ± 10.00", "paper": "-10.00"}
    assert "+10.0 ± 10.0" in forms[".md"]


def test_tables_are_the_same_bytes_whatever_the_order_of_rows(tmp_path):
    for name in ("hierarchy", "lerf", "ablation"):
        (tmp_path / "forward").mkdir(exist_ok=True)
        (tmp_path / "backward").mkdir(exist_ok=True)
        built(tmp_path / "forward", name)
        built(tmp_path / "backward", name, SCORES[::-1])
        for suffix in (".csv", ".md", ".tex", ".html"):
            first, second = (tmp_path / each / f"{name}{suffix}" for each in ("forward", "backward"))
            assert first.read_bytes() == second.read_bytes()


def block(*values, **more):
    rows = tuple(Row({"Method": str(number)}, {"x": cell}) for number, cell in enumerate(values))
    return Block("reported", "d", "t", rows, ("x",), **more)


def test_best_three_share_ranks_when_equal():
    cells = [Cell.printed(text) for text in ("10.0", "30.0", "30.0", "20.0", "-", "25x3", "5.0")]
    assert block(*cells).ranks() == {(1, "x"): 1, (2, "x"): 1, (3, "x"): 2, (0, "x"): 3}
    lower = block(*cells, lower_is_better=frozenset({"x"})).ranks()
    assert lower == {(6, "x"): 1, (0, "x"): 2, (3, "x"): 3}
    assert block(Cell.printed("10.0")).ranks() == {}  # a single row is not ranked


def test_latex_and_html_hold_every_reported_value_and_the_notes_below(tmp_path):
    _, forms = built(tmp_path, "lerf")
    for entry in read_published(PUBLISHED / "lerf.csv"):
        if entry["value"] != "-":
            assert entry["value"] in forms[".tex"]
            assert entry["value"] in forms[".html"]
    assert forms[".tex"].count(r"\toprule") == forms[".tex"].count(r"\bottomrule") == 2
    assert forms[".html"].count("<table>") == forms[".html"].count("</table>") == 2
    assert "The printed scenes average to 70.7." in forms[".md"]
    assert "<sup>" in forms[".html"]
    assert latex_text("50 % of a_b & c > d") == r"50 \% of a\_b \& c \textgreater{} d"


def test_unknown_table_names_those_that_exist(tmp_path):
    with pytest.raises(ArtifactError, match="one of lerf, 3dovs, replica"):
        run_table("leftovers", [], PUBLISHED / "lerf.csv", {}, tmp_path / "x.csv")


def test_tables_do_not_load_torch_or_opencv(tmp_path):
    arguments = f"'lerf', [], Path({str(PUBLISHED / 'lerf.csv')!r}), {{}}, Path({str(tmp_path / 'l.csv')!r})"
    code = (
        "import sys; from pathlib import Path; from hilsplat.evaluate.tables.build import run_table; "
        f"run_table({arguments}); "
        "print([name for name in ('torch', 'cv2', 'matplotlib', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


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


def value(name, method, column):
    entries = read_published(PUBLISHED / f"{name}.csv")
    (found,) = [e["value"] for e in entries if (e["method"], e["column"]) == (method, column)]
    return found


@pytest.mark.parametrize(
    ("name", "method", "column", "expected"),
    [
        ("hierarchy", "Hi-LSplat", "Hi-LERF L3", "33.7"),
        ("hierarchy", "VCH", "Hi-3DOVS HC", "38.4"),
        ("lerf", "SuperGSeg", "Teatime mBIoU", "78.0"),
        ("lerf", "LSeg", "Ramen localization", "14.1"),
        ("lerf", "Open3DRF-GS", "Average mBIoU", "44.6"),
        ("ablation", "Initial-2D, 3D-HC, Part", "Hi-LERF HC", "49.3"),
        ("omega", "Omega = 1000", "LERF mIoU", "65.2"),
        ("theta", "theta = 0.6", "3D-OVS mIoU", "95.4"),
        ("3dovs", "Gaussian Grouping", "Bed mIoU", "97.3"),
        ("replica", "Gaussian Grouping", "office1 mIoU", "-"),
        ("replica", "Hi-LSplat", "room2 mAcc", "65.01"),
        ("scannet", "Dr. Splat", "10 classes mAcc", "73.5"),
        ("waymo", "Hi-LSplat", "mIoU", "69.5"),
        ("efficiency", "LangSplat", "Training (min)", "25x3"),
        ("cost", "VCH", "Teatime query (s)", "0.30"),
        ("pruning", "Hi-LSplat, pruned pairs", "3D-OVS query (s)", "0.17"),
        ("frames-hi-lerf", "7", "Figurines", "frame_00152"),
        ("frames-hi-3dovs", "6", "table", "frame_31"),
    ],
)
def test_values_are_as_printed(name, method, column, expected):
    assert value(name, method, column) == expected


@pytest.mark.parametrize(
    ("name", "average", "parts"),
    [
        *(
            ("hierarchy", f"{d} Avg", [f"{d} L{level}" for level in (1, 2, 3)])
            for d in ("Hi-LERF", "Hi-3DOVS")
        ),
        *(
            ("lerf", f"Average {m}", [f"{s} {m}" for s in ("Figurines", "Ramen", "Teatime", "Waldo kitchen")])
            for m in ("mIoU", "mBIoU", "localization")
        ),
        ("3dovs", "Overall mIoU", [f"{s} mIoU" for s in ("Bed", "Bench", "Room", "Sofa", "Lawn")]),
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


def test_swapped_ap_columns_carry_a_note():
    entries = read_published(PUBLISHED / "scannet.csv")
    notes = [e["note"] for e in entries if e["method"] == "Hi-LSplat" and "AP@" in e["column"]]
    assert all("exchanged" in note for note in notes)
