"""Score files, and their means as a run and `evaluate-files` print them."""

import pandas as pd
import pytest

from hilsplat.base.errors import ArtifactError
from hilsplat.base.tables import read_csv
from hilsplat.cli.main import app
from hilsplat.datasets.classes import WAYMO_22
from hilsplat.evaluate.scores import COLUMNS, read_scores, write_scores
from hilsplat.evaluate.tables.means import mean_rows
from tests.unit.evaluate.builders import score

LABELS = {"default": "hilsplat"}


def means(*rows):
    """Rows of the table, each as a dict without empty cells."""
    columns, *found = mean_rows(pd.DataFrame(map(vars, rows), columns=list(COLUMNS)), LABELS)
    return [{name: cell for name, cell in zip(columns, row, strict=True) if cell} for row in found]


def test_each_method_and_protocol_has_a_row_averaged_as_its_card_says():
    tree, field = {"protocol": "lerf/tree-nodes@6"}, {"protocol": "lerf/langsplat@3", "method": "field"}
    pairs = [score("iou", 0.5, query="mug", **tree), score("iou", 1.0, query="pen", **tree)]
    localized = [score("localization_mask", 1.0, query="mug", **tree)]
    of_level = [score("iou", 0.9, level="whole"), score("iou", 0.7), score("iou", 0.2, level="part")]
    by_class = [
        score("iou", value, query=query, view=view, protocol="lerf-mask/gaussian-grouping@1")
        for query, view, value in (("mug", "1", 1.0), ("mug", "2", 1.0), ("pen", "1", 0.5))
    ]
    consistency = score("view_consistency", 0.4, protocol="world/view-consistency@2")
    other = score("iou", 0.25, variant="langsplat", **field)
    rows = means(*pairs, *localized, *of_level, *by_class, consistency, other)
    assert rows == [
        {"method": "hilsplat (tree)", "mIoU": "50.0", "whole": "80.0", "part": "20.0", "queries": "3"}
        | {"protocol": "hierarchy/level-given@6"},
        {"method": "hilsplat (tree)", "mIoU": "75.0", "queries": "3"}
        | {"protocol": "lerf-mask/gaussian-grouping@1"},
        {"method": "hilsplat (tree)", "mIoU": "75.0", "localized": "100.0", "queries": "2", **tree},
        {"method": "langsplat", "mIoU": "25.0", "queries": "1", "protocol": field["protocol"]},
    ]


def test_classes_of_a_pooled_protocol_are_averaged_from_their_points():
    """A class that is neither labelled nor predicted counts as 1 in Waymo's mean."""
    place = {"protocol": "waymo/segmentation@1 (points: nearest)", "level": "", "n": 10}
    rows = [
        score(metric, value, query=name, **place)
        for metric in ("class_iou", "class_accuracy")
        for name, value in zip(WAYMO_22.texts[:2], (0.8, 0.4), strict=True)
    ]
    mean = f"{100 * (0.8 + 0.4 + 20) / 22:.1f}"
    expected = {"method": "hilsplat (tree)", "mIoU": mean, "queries": "2", "protocol": place["protocol"]}
    assert means(*rows) == [expected]


def test_the_means_of_a_scene_are_written_as_markdown_and_csv(tmp_path):
    files = [tmp_path / variant / "scores.csv" for variant in ("default", "langsplat")]
    for path, value in zip(files, (0.75, 0.5), strict=True):
        write_scores(path, [score("iou", value, variant=path.parent.name, protocol="lerf/tree-nodes@6")])
    out = tmp_path / "scores.md"
    words = ["score-means", *map(str, files), "--out", str(out), "--names", '{"langsplat": "LangSplat"}']
    app(words, standalone_mode=False)
    rows = read_csv(out.with_suffix(".csv"), None, "")
    found = [(row["method"], row["mIoU"]) for row in rows]
    assert found == [("hilsplat (tree)", "75.0"), ("LangSplat, tree", "50.0")]
    assert "| hilsplat (tree) | 75.0 | 1 | lerf/tree-nodes@6 |" in out.read_text()
    write_scores(files[0], [])
    app([words[0], str(files[0]), *words[3:]], standalone_mode=False)
    assert read_csv(out.with_suffix(".csv"), None, "") == []


def test_labels_of_several_data_sets_are_not_averaged_together():
    theirs = [score("iou", 0.8, dataset="lerf_ovs", query=text, protocol="lerf/langsplat@3") for text in "ab"]
    own = score("iou", 0.0, dataset="annotated", protocol="lerf/langsplat@3")
    found = [(row["labels"], row["mIoU"]) for row in means(*theirs, own)]
    assert found == [("annotated", "0.0"), ("lerf_ovs", "80.0")]


def test_score_files_are_sorted_and_stable(tmp_path):
    rows = [
        score("iou", 1 / 3, query="b"),
        score("iou", 0.5, query="a, or b"),
        score("boundary_iou", 0.5, query="a"),
    ]
    write_scores(tmp_path / "one.csv", rows)
    write_scores(tmp_path / "two.csv", rows[::-1])
    text = (tmp_path / "one.csv").read_bytes()
    assert text == (tmp_path / "two.csv").read_bytes()
    assert text.decode().splitlines()[0] == ",".join(COLUMNS)
    frame = read_scores([tmp_path / "one.csv"])
    assert list(frame["query"]) == ["a", "a, or b", "b"]
    assert frame["value"].tolist() == [0.5, 0.5, 0.333333]


def test_queries_like_formulas_are_inert_in_spreadsheets_and_read_back_unchanged(tmp_path):
    write_scores(
        tmp_path / "scores.csv", [score("iou", 0.5, query='=HYPERLINK("x")'), score("iou", 0.0, query="-")]
    )
    assert ",\"'=HYPERLINK" in (tmp_path / "scores.csv").read_text()
    assert list(read_scores([tmp_path / "scores.csv"])["query"]) == ["-", '=HYPERLINK("x")']
    text = (tmp_path / "scores.csv").read_text()
    (tmp_path / "scores.csv").write_text(text.replace("0.500000", "half"))
    with pytest.raises(ArtifactError, match=r"scores\.csv cannot be read: .*'half'"):
        read_scores([tmp_path / "scores.csv"])


def test_other_columns_are_refused_by_name(tmp_path):
    (tmp_path / "scores.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ArtifactError, match=r"found     a, b"):
        read_scores([tmp_path / "scores.csv"])
