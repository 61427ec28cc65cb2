"""The paper's own rows, as transcribed in `config/published/`."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from hilsplat.base.tables import read_csv
from hilsplat.evaluate.tables.rows import Block, Cell, Row

PUBLISHED_COLUMNS = ("method", "family", "column", "value", "note")


def read_published(path: Path) -> list[dict[str, str]]:
    """Read the rows of a published table: method, family, column, value, note.

    Raises:
        ArtifactError: the file is missing or has different columns.
    """
    return read_csv(path, PUBLISHED_COLUMNS, "restore it from the repository")


def reported_block(
    published: Iterable[Mapping[str, str]],
    data: str,
    title: str,
    rename: Callable[[str], str | None] = lambda column: column,
    families: bool = True,
) -> Block:
    """Return a block with the paper's rows.

    Args:
        published: rows of a published table.
        data: data set.
        title: heading.
        rename: maps the paper's columns to ours, or to None to omit them.
        families: whether to include the family of each method.
    """
    rows: dict[tuple[str, str], dict[str, Cell]] = {}
    columns: dict[str, None] = {}
    for entry in published:
        column = rename(entry["column"])
        if column is None:
            continue
        columns[column] = None
        cells = rows.setdefault((entry["family"], entry["method"]), {})
        cells[column] = Cell.printed(entry["value"], entry["note"])
    return Block(
        "reported",
        data,
        title,
        tuple(
            Row({"Family": family, "Method": method} if families else {"Method": method}, cells)
            for (family, method), cells in rows.items()
            if any(cell.text != "-" for cell in cells.values())
        ),
        tuple(columns),
    )
