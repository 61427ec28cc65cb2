"""Parts of a table: cells, rows, blocks of one kind, footnotes."""

import re
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Cell:
    """One value of a table.

    Attributes:
        text: displayed text.
        value: the number used for ranking, if any.
        note: footnote, or empty.
        spread: number after ±, usually the standard deviation over seeds; None without one.
    """

    text: str = "-"
    value: float | None = None
    note: str = ""
    spread: float | None = None

    @staticmethod
    def percent(value: float) -> "Cell":
        """Format a share in [0, 1] as a percentage with one decimal; nan as a dash."""
        return Cell() if value != value else Cell(f"{100 * value:.1f}", 100 * value)

    @staticmethod
    def number(value: float) -> "Cell":
        """Format a number with two decimals; nan as a dash."""
        return Cell() if value != value else Cell(f"{value:.2f}", value)

    @staticmethod
    def printed(text: str, note: str = "") -> "Cell":
        """Return a value as printed in the paper."""
        number = re.fullmatch(r"-?\d+(\.\d+)?", text)
        return Cell(text, float(text) if number else None, note)


@dataclass(frozen=True)
class Row:
    """One method: names on the left, values by column, and its ranking group, if any."""

    names: Mapping[str, str]
    cells: Mapping[str, Cell]
    ranked_with: str | None = ""

    def cell(self, column: str) -> Cell:
        """Return the value of a column; a dash if the row has none."""
        return self.cells.get(column, Cell())


@dataclass(frozen=True)
class Block:
    """Rows of one kind and one data set.

    Attributes:
        kind: `reported`, `measured` or `synthetic stand-in`.
        data: data set.
        title: heading.
        rows: rows in display order.
        columns: value columns in display order.
        lower_is_better: columns in which the smallest value is best.
        unranked: columns without ranking.
    """

    kind: str
    data: str
    title: str
    rows: tuple[Row, ...]
    columns: tuple[str, ...]
    lower_is_better: frozenset[str] = frozenset()
    unranked: frozenset[str] = frozenset()

    def names(self) -> list[str]:
        """Return the name columns, in order of appearance."""
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
                if row.ranked_with is not None and cell.value is not None:
                    # Displayed values are compared, so that equal texts get equal marks.
                    shown = float(cell.text.partition(" ")[0])
                    groups.setdefault(row.ranked_with, {})[number] = shown
            for values in groups.values():
                if len(values) < 2:
                    continue
                best = sorted(set(values.values()), reverse=column not in self.lower_is_better)[:3]
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
        """Return the cell notes, numbered in reading order."""
        notes: dict[str, int] = {}
        for block in self.blocks:
            for row in block.rows:
                for column in block.columns:
                    note = row.cell(column).note
                    if note:
                        notes.setdefault(note, len(notes) + 1)
        return notes
