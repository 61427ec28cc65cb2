"""Input of the tables, the paper's rows, and the warnings below them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from hilsplat.base.tables import read_csv
from hilsplat.evaluate.tables.rows import Block, Cell, Row, Table
from hilsplat.segment.origin import made_from_truth

if TYPE_CHECKING:
    import pandas as pd

    from hilsplat.evaluate.metrics.instances import InstanceMatches
    from hilsplat.evaluate.tables.costs import Cost

PUBLISHED_COLUMNS = ("method", "family", "column", "value", "note")

STAND_IN_NOTE = (
    "Rows of a synthetic stand-in are measured on generated scenes with the models named under Masks. "
    "They show how the parts of the method compare with each other and are not comparable with reported "
    "rows."
)

TRUE_MASKS_NOTE = (
    "Rows that begin with 'diagnostic, true masks' were given masks made from the true labels, with the "
    "faults named under Masks. They are not results and are not ranked; they separate errors of the "
    "method from errors of the segmenter."
)

SEEDS_NOTE = "Values with ± are mean and standard deviation over seeds; nothing is random in rows without ±."


def read_published(path: Path) -> list[dict[str, str]]:
    """Read the rows of one of the paper's tables, as transcribed in `config/published/`.

    Raises:
        ArtifactError: the file is missing or has different columns.
    """
    return read_csv(path, PUBLISHED_COLUMNS, "restore it from the repository")


@dataclass(frozen=True)
class Sources:
    """All input of the tables.

    Attributes:
        published: the paper's values (`read_published`).
        scores: rows of all score files.
        labels: variant -> its name in tables.
        costs: time and memory of scenes and variants, if the table contains them.
        instances: matches per (data set, scene, variant, masks, method), if scans have instances.
        absent: a sentence with the reason for each data set that was not measured.
    """

    published: Sequence[Mapping[str, str]]
    scores: "pd.DataFrame"
    labels: Mapping[str, str]
    costs: Sequence["Cost"] = ()
    instances: Mapping[tuple[str, ...], "InstanceMatches"] = field(default_factory=dict)
    absent: Sequence[str] = ()

    def reported(
        self,
        data: str,
        title: str = "",
        rename: Callable[[str], str | None] = lambda column: column,
        families: bool = True,
    ) -> Block:
        """Return a block with the paper's rows.

        Args:
            title: what the heading names; by default the data set.
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
        """Return a table with the warnings required by its rows."""
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
