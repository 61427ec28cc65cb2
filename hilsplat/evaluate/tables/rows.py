"""Parts of a table: cells, rows, blocks of one kind, footnotes."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field


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
    def number(value: float, digits: int = 1) -> "Cell":
        """Format a number with the given decimals; nan as a dash."""
        return Cell() if value != value else Cell(f"{value:.{digits}f}", value)

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
                cell = row.cells.get(column, Cell())
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
    footnotes: tuple[str, ...] = field(default=())

    def numbered_notes(self) -> dict[str, int]:
        """Return the cell notes, numbered in reading order."""
        notes: dict[str, int] = {}
        for block in self.blocks:
            for row in block.rows:
                for column in block.columns:
                    note = row.cells.get(column, Cell()).note
                    if note:
                        notes.setdefault(note, len(notes) + 1)
        return notes


def shown_columns(block: Block) -> tuple[list[str], list[str]]:
    """Return the name and value columns of a block; empty value columns are omitted."""
    names = list(dict.fromkeys(name for row in block.rows for name in row.names))
    values = [
        column
        for column in block.columns
        if any(row.cells.get(column, Cell()).text != "-" for row in block.rows)
    ]
    return names, values
