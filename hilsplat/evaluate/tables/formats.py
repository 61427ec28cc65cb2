"""A table as CSV, Markdown, LaTeX and HTML.

pandas' Styler is not used, because it does not escape < and ± in LaTeX and has no footnotes, would need as
much code, and writes an id and three classes per cell, so HTML files would be 1.6 to 2.5 times as large.
"""

import html
import re
from collections import Counter
from collections.abc import Iterator, Sequence

from hilsplat.base.tables import plain_markdown
from hilsplat.evaluate.tables.rows import Block, Cell, Table

LATEX_NAMES = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    ">": r"\textgreater{}",
    "<": r"\textless{}",
    "±": r"$\pm$",
}
LATEX_SPECIAL = str.maketrans({letter: "\\" + letter for letter in "&%$#_{}"} | LATEX_NAMES)

HTML_STYLE = """<style>
.hilsplat-table { font: 14px/1.4 system-ui, sans-serif; color: #1b1b1b; background: #fff; padding: 1em; }
.hilsplat-table table { border-collapse: collapse; margin: 0 0 1.2em; }
.hilsplat-table h3 { font-size: 1em; margin: .4em 0; }
.hilsplat-table th, .hilsplat-table td { padding: .2em .6em; text-align: right; white-space: nowrap; }
.hilsplat-table th { border-bottom: 1px solid #444; font-weight: 600; white-space: normal; }
.hilsplat-table th { vertical-align: bottom; }
.hilsplat-table .name { text-align: left; }
.hilsplat-table tr { background: #fff; }
.hilsplat-table tbody tr:nth-child(even) { background: #f6f6f6; }
.hilsplat-table tr > :first-child { position: sticky; left: 0; background: inherit; }
.hilsplat-table .rank1 { background: rgb(255,179,179); font-weight: 700; }
.hilsplat-table .rank2 { background: rgb(255,217,179); }
.hilsplat-table .rank3 { background: rgb(255,255,179); }
.hilsplat-table .scroll { overflow-x: auto; }
.hilsplat-table .notes { max-width: 60em; font-size: 13px; }
</style>"""


def csv_rows(table: Table) -> tuple[list[str], list[list[str]]]:
    """Return the columns and rows of all blocks: measured values with two decimals, others as printed.

    Blocks may spell a scene differently: the paper writes Waldo kitchen, the data set waldo_kitchen. Columns
    that differ only in case, spaces and _ are therefore the same, unless a block has several of them.
    """
    names = list(dict.fromkeys(name for block in table.blocks for name in block.names()))
    several = {
        key for block in table.blocks for key, n in Counter(map(_plain, block.columns)).items() if n > 1
    }

    def by_key(block: Block) -> dict[str, str]:
        return {column if (key := _plain(column)) in several else key: column for column in block.columns}

    values: dict[str, str] = {}
    for block in table.blocks:
        for key, column in by_key(block).items():
            values.setdefault(key, column)
    rows = []
    for block in table.blocks:
        rows_by_key = by_key(block)
        for row in block.rows:
            cells = [row.cell(rows_by_key[key]) if key in rows_by_key else Cell() for key in values]
            notes = " ".join(dict.fromkeys(cell.note for cell in cells if cell.note))
            texts = [_csv_value(cell, block.kind) for cell in cells]
            rows.append([block.kind, block.data, *(row.names.get(n, "") for n in names), *texts, notes])
    return ["kind", "data", *(name.lower() for name in names), *values.values(), "notes"], rows


def _plain(column: str) -> str:
    return re.sub("[ _]", "", column).casefold()


def _csv_value(cell: Cell, kind: str) -> str:
    if kind == "reported" or cell.value is None or cell.text.isdigit():
        return "" if cell.text == "-" else cell.text
    return f"{cell.value:.2f}" + (f" ± {cell.spread:.2f}" if cell.spread is not None else "")


def shown_rows(block: Block, notes: dict[str, int]) -> Iterator[tuple[list[str], list[tuple[str, int, str]]]]:
    """Yield the names of each row, and the text, rank (0 for none) and footnote number of each value."""
    names, columns, ranks = block.names(), block.filled_columns(), block.ranks()
    for number, row in enumerate(block.rows):
        values = []
        for column in columns:
            cell = row.cell(column)
            values.append((cell.text, ranks.get((number, column), 0), str(notes.get(cell.note, ""))))
        yield [row.names.get(name, "") for name in names], values


def as_markdown(table: Table) -> str:
    """Return the table as Markdown: best values bold, second-best underlined, third-best italic."""
    marks = {1: "**{}**", 2: "<u>{}</u>", 3: "*{}*", 0: "{}"}
    notes = table.numbered_notes()
    lines = [f"# {table.title}", ""]
    for block in table.blocks:
        names, values = block.names(), block.filled_columns()
        header = " | ".join(map(plain_markdown, [*names, *values]))
        lines += [f"## {plain_markdown(block.title)}", "", f"| {header} |"]
        lines.append("|" + "---|" * len(names) + "---:|" * len(values))
        for texts, ranked in shown_rows(block, notes):
            cells = [plain_markdown(text) for text in texts]
            for text, rank, note in ranked:
                raised = f"<sup>{note}</sup>" if note else ""
                cells.append(marks[rank].format(plain_markdown(text)) + raised)
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    lines += ["Best three in a block and protocol: **best**, <u>second</u>, *third*.", ""]
    lines += [f"- {_inert(note)}".replace("*:", "\\*:") for note in table.footnotes]
    lines += [f"- <sup>{number}</sup> {_inert(note)}" for note, number in notes.items()]
    return "\n".join(lines).rstrip() + "\n"


def _inert(note: str) -> str:
    """Return a note with HTML and links disabled; Markdown emphasis is kept."""
    return " ".join(note.replace("<", "&lt;").replace("](", "]\\(").splitlines())


def latex_text(text: str) -> str:
    return " ".join(text.splitlines()).translate(LATEX_SPECIAL)


def latex_row(cells: Sequence[str]) -> str:
    """Join escaped cells; a bracket or star would be read as an argument of the line before."""
    row = " & ".join(cells) + r" \\"
    return "{}" + row if row.startswith(("[", "*")) else row


def as_latex(table: Table) -> str:
    """Return a booktabs table with footnotes: best values bold, second-best underlined, third-best italic."""
    marks = {1: r"\textbf{%s}", 2: r"\underline{%s}", 3: r"\textit{%s}", 0: "%s"}
    notes = table.numbered_notes()
    lines = [r"% needs \usepackage{booktabs,graphicx}", r"\begin{table*}[t]", r"\centering"]
    lines.append(rf"\caption{{{latex_text(table.title)}.}}\label{{tab:{table.name}}}")
    for block in table.blocks:
        names, values = block.names(), block.filled_columns()
        lines += [rf"\par\smallskip\textit{{{latex_text(block.title)}}}\par\smallskip"]
        lines += [r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"]
        lines += [rf"\begin{{tabular}}{{{'l' * len(names)}{'r' * len(values)}}}", r"\toprule"]
        lines += [latex_row(list(map(latex_text, [*names, *values]))), r"\midrule"]
        for texts, ranked in shown_rows(block, notes):
            cells = [latex_text(text) for text in texts]
            for text, rank, note in ranked:
                raised = rf"\textsuperscript{{{note}}}" if note else ""
                cells.append(marks[rank] % latex_text(text) + raised)
            lines.append(latex_row(cells))
        lines += [r"\bottomrule", r"\end{tabular}}"]
    lines.append(r"\par\smallskip\raggedright\footnotesize")
    lines += [latex_text(note) + r"\par" for note in table.footnotes]
    lines += [rf"\textsuperscript{{{number}}} {latex_text(note)}\par" for note, number in notes.items()]
    lines.append(r"\end{table*}")
    return "\n".join(lines) + "\n"


def as_html(table: Table) -> str:
    """Return an HTML fragment for the report; best, second and third are coloured as in the paper."""
    notes = table.numbered_notes()
    lines = [HTML_STYLE, '<div class="hilsplat-table">', f"<h2>{html.escape(table.title)}</h2>"]
    for block in table.blocks:
        lines += [f"<h3>{html.escape(block.title)}</h3>", '<div class="scroll"><table><thead><tr>']
        lines += [f'<th class="name">{html.escape(name)}</th>' for name in block.names()]
        lines += [f"<th>{html.escape(column)}</th>" for column in block.filled_columns()]
        lines += ["</tr></thead>", "<tbody>"]
        for texts, ranked in shown_rows(block, notes):
            cells = [f'<td class="name">{html.escape(text)}</td>' for text in texts]
            for text, rank, note in ranked:
                mark = f' class="rank{rank}"' if rank else ""
                raised = f"<sup>{note}</sup>" if note else ""
                cells.append(f"<td{mark}>{html.escape(text)}{raised}</td>")
            lines.append("<tr>" + "".join(cells) + "</tr>")
        lines.append("</tbody></table></div>")
    lines.append('<div class="notes">')
    lines += [f"<p>{html.escape(note)}</p>" for note in table.footnotes]
    lines += [f"<p><sup>{number}</sup> {html.escape(note)}</p>" for note, number in notes.items()]
    lines += ["</div>", "</div>"]
    return "\n".join(lines) + "\n"
