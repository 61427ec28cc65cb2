"""Parts of a table (cells, rows, blocks of one kind, footnotes) and the input from which tables are built."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from hilsplat.base.tables import read_csv
from hilsplat.segment.origin import made_from_truth

if TYPE_CHECKING:
    import pandas as pd

    from hilsplat.evaluate.metrics.instances import InstanceMatches
    from hilsplat.evaluate.tables.costs import Cost

PUBLISHED_COLUMNS = ("method", "family", "column", "value", "note")

STAND_IN_NOTE = (
    "Rows of a synthetic stand-in are measured on generated scenes with the models named under Masks. "
    "They compare components of the method with each other and are not comparable with reported rows."
)

TRUE_MASKS_NOTE = (
    "Rows that begin with 'diagnostic, true masks' use masks made from the true labels, with the "
    "faults named under Masks. They are not results and are not ranked; they separate errors of the "
    "method from errors of the segmenter."
)

SEEDS_NOTE = "Values with ± are mean and standard deviation over seeds; rows without ± are deterministic."


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
    unranked: frozenset[str] = frozenset()

    @property
    def lower_is_better(self) -> frozenset[str]:
        """Columns of times and memory, in which the smallest value is best."""
        return frozenset(column for column in self.columns if column.endswith(("(min)", "(GB)", "(s)")))

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
                    # Displayed values are compared, so that equal texts get the same rank.
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
        cells = (row.cell(column) for block in self.blocks for row in block.rows for column in block.columns)
        notes = dict.fromkeys(cell.note for cell in cells if cell.note)
        return {note: number for number, note in enumerate(notes, start=1)}


def read_published(path: Path) -> list[dict[str, str]]:
    """Read the rows of one of the paper's tables, as transcribed in `config/published/`."""
    return read_csv(path, PUBLISHED_COLUMNS, "restore it from the repository")


@dataclass(frozen=True)
class Sources:
    """All inputs of the tables."""

    published: Sequence[Mapping[str, str]]  # the paper's values (`read_published`)
    scores: "pd.DataFrame"
    labels: Mapping[str, str]  # variant -> its name in tables
    costs: Sequence["Cost"] = ()  # by scene and variant, if the table contains costs
    # by (data set, scene, variant, masks, method), if scans have instances
    instances: Mapping[tuple[str, ...], "InstanceMatches"] = field(default_factory=dict)
    absent: Sequence[str] = ()  # a sentence with the reason for each data set that was not measured

    def reported(
        self,
        data: str,
        title: str = "",
        rename: Callable[[str], str | None] = lambda column: column,
        families: bool = True,
    ) -> Block:
        """Return a block with the paper's rows.

        Args:
            title: name used in the heading; by default the data set.
            rename: maps the paper's columns to ours, or to None to omit them.
            families: whether to include the family of each method.
        """
        rows: dict[tuple[str, str], dict[str, Cell]] = {}
        columns: dict[str, None] = {}
        for entry in self.published:
            column = rename(entry["column"])
            if column is None:
                continue
            columns[column] = None
            cells = rows.setdefault((entry["family"], entry["method"]), {})
            cells[column] = Cell.printed(entry["value"], entry["note"])
        shown = tuple(
            Row({"Family": family, "Method": method} if families else {"Method": method}, cells)
            for (family, method), cells in rows.items()
            if any(cell.text != "-" for cell in cells.values())
        )
        return Block("reported", data, f"Reported in the paper: {title or data}", shown, tuple(columns))

    def finished(self, name: str, title: str, blocks: Iterable[Block], footnotes: Sequence[str]) -> Table:
        """Return a table with its footnotes and the warnings that its rows require."""
        blocks = tuple(block for block in blocks if block.rows)
        warnings = []
        rows = [row for block in blocks for row in block.rows]
        if any(block.kind == "synthetic stand-in" for block in blocks):
            warnings.append(STAND_IN_NOTE)
        if any(made_from_truth(row.names.get("Masks", "")) for row in rows):
            warnings.append(TRUE_MASKS_NOTE)
        if any("Seeds" in row.names for row in rows):
            warnings.append(SEEDS_NOTE)
        absent = [f"Not measured: {sentence}" for sentence in self.absent]
        return Table(name, title, blocks, (*warnings, *footnotes, *absent))
