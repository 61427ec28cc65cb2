"""Score files."""

import pytest

from hilsplat.base.errors import ArtifactError
from hilsplat.evaluate.scores import COLUMNS, read_scores, write_scores
from tests.unit.evaluate.builders import score


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
