"""Parts of a table (cells, rows, blocks of one kind, footnotes) and the input from which tables are built."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from hilsplat.base.tables import read_csv
from hilsplat.evaluate.costs import Cost
from hilsplat.evaluate.metrics.instances import InstanceMatches

if TYPE_CHECKING:  # takes a quarter of a second, and workflow start-up doesn't need it
    import pandas as pd

PUBLISHED_COLUMNS = ("method", "family", "column", "value", "note")


@dataclass(frozen=True)
class Cell:
    """One table cell: text, number for ranking (if any), footnote, and the number after ± (if any)."""

    text: str = "-"
    value: float | None = None
    note: str = ""
    spread: float | None = None

    @staticmethod
    def percent(value: float) -> "Cell":
        """Format a fraction in [0, 1] as a percentage with one decimal, and nan as a dash."""
        return Cell() if value != value else Cell(f"{100 * value:.1f}", 100 * value)

    @staticmethod
    def number(value: float) -> "Cell":
        """Format a number with two decimals, and nan as a dash."""
        return Cell() if value != value else Cell(f"{value:.2f}", value)

    @staticmethod
    def count(value: int) -> "Cell":
        return Cell(str(value), float(value))

    @staticmethod
    def printed(text: str, note: str = "") -> "Cell":
        number = re.fullmatch(r"-?\d+(\.\d+)?", text)
        return Cell(text, float(text) if number else None, note)


@dataclass(frozen=True)
class Row:
    """One method: names on the left, values by column, and its ranking group, if any."""

    names: Mapping[str, str]
    cells: Mapping[str, Cell]
    ranked_with: str | None = ""
    unranked: tuple[str, ...] = ()  # columns in which it can't be compared with other rows

    def cell(self, column: str) -> Cell:
        """Return the cell of a column; a dash if the row has no value there."""
        return self.cells.get(column, Cell())


@dataclass(frozen=True)
class Block:
    """Rows of one kind and one data set."""

    kind: str  # `reported`, `measured` or `synthetic stand-in`
    data: str
    title: str
    rows: tuple[Row, ...]
    columns: tuple[str, ...]  # value columns in display order
    unranked: tuple[str, ...] = ()

    @property
    def costs(self) -> tuple[str, ...]:
        """Columns of times and memory, in which the smallest value is best."""
        return tuple(column for column in self.columns if column.endswith(("(min)", "(GB)", "(s)")))

    def names(self) -> list[str]:
        return list(dict.fromkeys(name for row in self.rows for name in row.names))

    def filled_columns(self) -> list[str]:
        """Return the value columns in which any row has a value."""
        return [column for column in self.columns if any(row.cell(column).text != "-" for row in self.rows)]

    def ranks(self) -> dict[tuple[int, str], int]:
        """Map (row, column) to 1, 2 or 3 for the three best values within a ranking group.

        Equal values share a rank. A single row is not ranked.
        """
        ranks: dict[tuple[int, str], int] = {}
        for column in self.columns:
            if column in self.unranked:
                continue
            groups: dict[str, dict[int, float]] = {}
            for number, row in enumerate(self.rows):
                cell = row.cell(column)
                if row.ranked_with is not None and cell.value is not None and column not in row.unranked:
                    # Displayed values are compared, so that equal texts get the same rank.
                    value = float(cell.text.partition(" ")[0])
                    groups.setdefault(row.ranked_with, {})[number] = value
            for values in groups.values():
                if len(values) < 2:
                    continue
                best = sorted(set(values.values()), reverse=column not in self.costs)[:3]
                for number, value in values.items():
                    if value in best:
                        ranks[number, column] = best.index(value) + 1
        return ranks


@dataclass(frozen=True)
class Table:
    """A titled table of blocks with footnotes below."""

    name: str
    title: str
    blocks: tuple[Block, ...]
    footnotes: tuple[str, ...]

    def numbered_notes(self) -> dict[str, int]:
        cells = (row.cell(column) for block in self.blocks for row in block.rows for column in block.columns)
        notes = dict.fromkeys(cell.note for cell in cells if cell.note)
        return {note: number for number, note in enumerate(notes, start=1)}


@dataclass(frozen=True)
class Sources:
    """All inputs of the tables."""

    published: Sequence[Mapping[str, str]]  # the paper's values (`read_published`)
    scores: "pd.DataFrame"
    labels: Mapping[str, str]  # variant -> its name in tables
    costs: Sequence[Cost] = ()  # by scene and variant, if the table contains costs
    # by (data set, scene, variant, masks, method), if scans have instances
    instances: Mapping[tuple[str, ...], InstanceMatches] = field(default_factory=dict)


def read_published(path: Path) -> list[dict[str, str]]:
    """Read the rows of one of the paper's tables, as transcribed in `config/published/`."""
    return read_csv(path, PUBLISHED_COLUMNS, "restore it from the repository")


def reported_block(
    published: Sequence[Mapping[str, str]],
    data: str,
    heading: str = "",
    prefix: str = "",
    renamed: Mapping[str, str] | None = None,
    families: bool = True,
) -> Block:
    """Return a block with the paper's rows.

    Args:
        heading: name used in the heading; by default the data set.
        prefix: only columns that begin with it are shown, without it.
        renamed: the paper's columns (without prefix) -> ours, if different.
        families: whether to include the family of each method.
    """
    rows: dict[tuple[str, str], dict[str, Cell]] = {}
    columns: dict[str, None] = {}
    for entry in published:
        if not entry["column"].startswith(prefix):
            continue
        column = entry["column"].removeprefix(prefix)
        column = (renamed or {}).get(column, column)
        columns[column] = None
        cells = rows.setdefault((entry["family"], entry["method"]), {})
        cells[column] = Cell.printed(entry["value"], entry["note"])
    filled = tuple(
        Row({"Family": family, "Method": method} if families else {"Method": method}, cells)
        for (family, method), cells in rows.items()
        if any(cell.text != "-" for cell in cells.values())
    )
    return Block("reported", data, f"Reported in the paper: {heading or data}", filled, tuple(columns))
