"""Small tables as CSV files with fixed columns, Markdown and text; counts with their nouns."""

import csv
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hilsplat.base.artifacts import write_text
from hilsplat.base.errors import ArtifactError, foreign
from hilsplat.base.files import regular

FORMULA = r"(?='*(?![-+][\d.]+(e[-+]?\d+)?( ± [\d.]+)?\Z)[=+\-@\t\r\n](?s:.))"
"""Beginning of a text, but not of a number, that a spreadsheet would run, perhaps after our apostrophes."""

FORMULA_BEGINS = tuple("'=+-@\t\r\n")  # first letters of such texts


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a header and rows with an apostrophe before formulas; identical rows produce identical bytes."""
    lines: list[str] = []
    writer = csv.writer(SimpleNamespace(write=lines.append))  # its lines end in CRLF; else it quotes no CR
    for row in (columns, *rows):
        writer.writerow([_inert(cell) if isinstance(cell, str) else cell for cell in row])
    write_text(path, "".join(line.removesuffix("\r\n") + "\n" for line in lines))


def _inert(cell: str) -> str:
    """Put an apostrophe before a formula; most cells begin with another letter, and matching takes long."""
    return re.sub(f"^{FORMULA}", "'", cell) if cell.startswith(FORMULA_BEGINS) else cell


def read_csv(path: Path, columns: Sequence[str] | None, fix: str) -> list[dict[str, str]]:
    """Return the rows of a file from `write_csv`; None accepts any columns.

    ArtifactError, with `fix`, is raised if the file is missing or damaged, or has different columns.
    """
    with foreign(path, ArtifactError, fix=fix):
        with regular(Path(path)).open(encoding="utf-8", newline="") as stream:
            lines = [line for line in csv.reader(stream) if line]
        header, *rows = (
            [re.sub(f"^'{FORMULA}", "", cell) if cell.startswith("'") else cell for cell in line]
            for line in lines
        )
        table = [dict(zip(header, row, strict=True)) for row in rows]
    if columns is not None and tuple(header) != tuple(columns):
        raise ArtifactError(
            f"{path} has unexpected columns", expected=", ".join(columns), found=", ".join(header), fix=fix
        )
    return table


def described(entries: Mapping[str, Mapping[str, Any]], name: str) -> dict[str, Any]:
    """Return an entry; the fields that it omits are those of the entry that its field `like` names."""
    fields = dict(entries[name])
    base = fields.pop("like", None)
    return {**described(entries, base), **fields} if base else fields


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


def aligned_table(rows: Sequence[Sequence[object]], words: Collection[str]) -> list[str]:
    """Return rows as aligned lines, the header first; the columns named in `words` begin at the left."""
    columns = []
    for column in zip(*rows, strict=True):
        texts = [str(cell) for cell in column]
        width, side = max(map(len, texts)), str.ljust if column[0] in words else str.rjust
        columns.append([side(text, width) for text in texts])
    return ["  ".join(row).rstrip() for row in zip(*columns, strict=True)]


def counted(count: int, noun: str) -> str:
    """Format a count with its noun: 1 node, 2 nodes."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
