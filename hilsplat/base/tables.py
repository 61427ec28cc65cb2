"""Small tables: CSV files with fixed columns, and Markdown."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from hilsplat.base.artifacts import write_text
from hilsplat.base.errors import ArtifactError


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a header and rows; identical rows produce identical bytes."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([columns, *rows])
    write_text(path, stream.getvalue())


def read_csv(path: Path, columns: Sequence[str], fix: str) -> list[dict[str, str]]:
    """Return the rows of a CSV file; raise ArtifactError with `fix` if it is missing or has wrong columns."""
    try:
        with Path(path).open(encoding="utf-8", newline="") as stream:
            reader = csv.DictReader(stream)
            rows = list(reader)
    except FileNotFoundError as error:
        raise ArtifactError(f"{path} is missing", fix=fix) from error
    if tuple(reader.fieldnames or ()) != tuple(columns):
        raise ArtifactError(
            f"{path} has unexpected columns",
            expected=", ".join(columns),
            found=", ".join(reader.fieldnames or ()),
            fix=fix,
        )
    return rows


def plain_markdown(text: str) -> str:
    """Escape a cell's text so that Markdown does not interpret it as columns, emphasis, links or HTML."""
    for mark in ("|", "*", "]("):
        text = text.replace(mark, f"\\{mark}" if len(mark) == 1 else "]\\(")
    return " ".join(text.replace("<", "&lt;").splitlines())


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[object]], words: int) -> str:
    """Format a Markdown table; the first `words` columns are text, the others are numbers."""
    numbers = len(columns) - words
    lines = [columns, ["---"] * words + ["---:"] * numbers, *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
