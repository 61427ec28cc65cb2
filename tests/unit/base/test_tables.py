"""CSV files: text that spreadsheets would run is inert, and is read back unchanged."""

import csv
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilsplat.base.errors import ArtifactError
from hilsplat.base.tables import aligned_table, read_csv, write_csv

TEXTS = st.text(st.characters(exclude_categories=["Cs"]) | st.sampled_from("'=+-@\t\r\n,\"1."), max_size=12)


@pytest.mark.parametrize(
    ("cell", "stored"),
    [
        ("=cmd|' /C calc'!A0", "'=cmd|' /C calc'!A0"),
        ("@SUM(A1)", "'@SUM(A1)"),
        ("+1+1", "'+1+1"),
        ("-2+3", "'-2+3"),
        ("\t=1", "'\t=1"),
        ("'=1", "''=1"),
        ("-0.25", "-0.25"),
        ("-0.25 ± 0.10", "-0.25 ± 0.10"),
        ("+1.5e+10", "+1.5e+10"),
        ("-1.5+A1", "'-1.5+A1"),
        ("-1e-3", "-1e-3"),
        ("-", "-"),
        ("mug = cup", "mug = cup"),
        ("'90s", "'90s"),
        (-0.25, "-0.25"),
    ],
)
def test_formulas_are_stored_as_text_and_numbers_as_numbers(
    tmp_path: Path, cell: object, stored: str
) -> None:
    write_csv(tmp_path / "a.csv", ["x", "y"], [[cell, 1]])
    with (tmp_path / "a.csv").open(newline="") as stream:
        assert list(csv.reader(stream))[1] == [stored, "1"]
    assert read_csv(tmp_path / "a.csv", ["x", "y"], "") == [{"x": str(cell), "y": "1"}]


@given(st.lists(st.tuples(TEXTS, TEXTS), max_size=4))
def test_every_text_is_read_back_unchanged(tmp_path_factory, rows: list[tuple[str, str]]) -> None:
    path = tmp_path_factory.getbasetemp() / "texts.csv"
    write_csv(path, ["=x", "y"], rows)
    assert [tuple(row.values()) for row in read_csv(path, ["=x", "y"], "")] == rows


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a\n1\n", r"unexpected columns\n.*x, y\n.*a\n  fix       do it"),
        (b"x,y\n1\n", "cannot be read: .* shorter"),
        (b"x,y\n1,2,3\n", "cannot be read: .* longer"),
        (b"x,y\n\xff,1\n", "cannot be read"),
        (b"", "cannot be read"),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(ArtifactError, match=message):
        read_csv(tmp_path / "a.csv", ["x", "y"], "do it")


def test_columns_of_numbers_end_at_the_right_and_no_rows_are_no_lines():
    rows = [["method", "mIoU", "protocol"], ["tree", 5.0, "p"], ["field, path", 55.0, "q"]]
    lines = ["method       mIoU  protocol", "tree          5.0  p", "field, path  55.0  q"]
    assert aligned_table(rows, ("method", "protocol")) == lines
    assert aligned_table([], ()) == []
