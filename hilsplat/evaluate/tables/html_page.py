"""A table as an HTML fragment for the report.

pandas' Styler is not used: the code would be as long, and an id and three classes per cell would make files
1.6 to 2.5 times as large.
"""

import html

from hilsplat.evaluate.tables.rows import Cell, Table, shown_columns

HTML_STYLE = """<style>
.hilsplat-table { font: 14px/1.4 system-ui, sans-serif; color: #1b1b1b; background: #fff; padding: 1em; }
.hilsplat-table table { border-collapse: collapse; margin: 0 0 1.2em; }
.hilsplat-table caption { text-align: left; font-weight: 600; padding: .4em 0; }
.hilsplat-table th, .hilsplat-table td { padding: .2em .6em; text-align: right; white-space: nowrap; }
.hilsplat-table th { border-bottom: 1px solid #444; font-weight: 600; }
.hilsplat-table .name { text-align: left; }
.hilsplat-table tbody tr:nth-child(even) { background: #f6f6f6; }
.hilsplat-table .rank1 { background: rgb(255,179,179); font-weight: 700; }
.hilsplat-table .rank2 { background: rgb(255,217,179); }
.hilsplat-table .rank3 { background: rgb(255,255,179); }
.hilsplat-table .scroll { overflow-x: auto; }
.hilsplat-table .notes { max-width: 60em; font-size: 13px; }
</style>"""


def as_html(table: Table) -> str:
    """Return an HTML fragment for the report; best, second and third are coloured as in the paper."""
    notes = table.numbered_notes()
    lines = [HTML_STYLE, '<div class="hilsplat-table">', f"<h2>{html.escape(table.title)}</h2>"]
    for block in table.blocks:
        names, values = shown_columns(block)
        ranks = block.ranks()
        lines += [
            '<div class="scroll"><table>',
            f"<caption>{html.escape(block.title)}</caption>",
            "<thead><tr>",
        ]
        lines += [f'<th class="name">{html.escape(name)}</th>' for name in names]
        lines += [f"<th>{html.escape(column)}</th>" for column in values]
        lines += ["</tr></thead>", "<tbody>"]
        for number, row in enumerate(block.rows):
            cells = [f'<td class="name">{html.escape(row.names.get(name, ""))}</td>' for name in names]
            for column in values:
                cell = row.cells.get(column, Cell())
                rank = ranks.get((number, column), 0)
                mark = f' class="rank{rank}"' if rank else ""
                note = f"<sup>{notes[cell.note]}</sup>" if cell.note else ""
                cells.append(f"<td{mark}>{html.escape(cell.text)}{note}</td>")
            lines.append("<tr>" + "".join(cells) + "</tr>")
        lines += ["</tbody></table></div>"]
    lines += ['<div class="notes">']
    lines += [f"<p>{html.escape(note)}</p>" for note in table.footnotes]
    lines += [f"<p><sup>{number}</sup> {html.escape(note)}</p>" for note, number in notes.items()]
    lines += ["</div>", "</div>"]
    return "\n".join(lines) + "\n"
