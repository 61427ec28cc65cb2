"""A table as CSV and as Markdown."""

import csv
import io

from hilsplat.base.tables import plain_markdown
from hilsplat.evaluate.tables.rows import Cell, Table, shown_columns


def as_csv(table: Table) -> str:
    """Return all blocks in one sheet; measured values with two decimals, reported ones as printed."""
    names = list(dict.fromkeys(name for block in table.blocks for row in block.rows for name in row.names))
    values = list(dict.fromkeys(column for block in table.blocks for column in block.columns))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["kind", "data", *(name.lower() for name in names), *values, "notes"])
    for block in table.blocks:
        for row in block.rows:
            cells = [row.cells.get(column, Cell()) for column in values]
            notes = " ".join(dict.fromkeys(cell.note for cell in cells if cell.note))
            shown = [_csv_value(cell, block.kind) for cell in cells]
            writer.writerow([block.kind, block.data, *(row.names.get(n, "") for n in names), *shown, notes])
    return stream.getvalue()


def _csv_value(cell: Cell, kind: str) -> str:
    if cell.text == "-":
        return ""
    if kind == "reported" or cell.value is None or cell.text.isdigit():
        return cell.text
    spread = f" ± {cell.spread:.2f}" if cell.spread is not None else ""
    return f"{cell.value:.2f}{spread}"


def as_markdown(table: Table) -> str:
    """Return the table as Markdown. Best bold, second underlined, third in italics."""
    marks = {1: "**{}**", 2: "<u>{}</u>", 3: "*{}*", 0: "{}"}
    notes = table.numbered_notes()
    lines = [f"# {table.title}", ""]
    for block in table.blocks:
        names, values = shown_columns(block)
        ranks = block.ranks()
        lines += [f"## {block.title}", "", "| " + " | ".join([*names, *values]) + " |"]
        lines.append("|" + "---|" * len(names) + "---:|" * len(values))
        for number, row in enumerate(block.rows):
            cells = [plain_markdown(row.names.get(name, "")) for name in names]
            for column in values:
                cell = row.cells.get(column, Cell())
                note = f"<sup>{notes[cell.note]}</sup>" if cell.note else ""
                cells.append(marks[ranks.get((number, column), 0)].format(cell.text) + note)
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    lines += ["Best three in a block and protocol: **best**, <u>second</u>, *third*.", ""]
    lines += [f"- {_plain(note)}".replace("*:", "\\*:") for note in table.footnotes]
    lines += [f"- <sup>{number}</sup> {_plain(note)}" for note, number in notes.items()]
    return "\n".join(lines).rstrip() + "\n"


def _plain(note: str) -> str:
    """Return a note without HTML or links; our own emphasis is kept."""
    return " ".join(note.replace("<", "&lt;").replace("](", "]\\(").splitlines())
