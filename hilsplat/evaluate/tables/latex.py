"""A table as LaTeX: booktabs, best three marked.

pandas' Styler is not used because it does not escape < and ± and has no footnotes.
"""

from hilsplat.evaluate.tables.rows import Cell, Table, shown_columns

LATEX_SPECIAL = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    ">": r"\textgreater{}",
    "<": r"\textless{}",
    "±": r"$\pm$",
}


def latex_text(text: str) -> str:
    """Escape characters that LaTeX would interpret."""
    return "".join(LATEX_SPECIAL.get(letter, letter) for letter in text)


def as_latex(table: Table) -> str:
    """Return a booktabs table with footnotes below. Best bold, second underlined, third italic."""
    marks = {1: r"\textbf{%s}", 2: r"\underline{%s}", 3: r"\textit{%s}", 0: "%s"}
    notes = table.numbered_notes()
    lines = [r"% needs \usepackage{booktabs,graphicx}", r"\begin{table*}[t]", r"\centering"]
    lines.append(rf"\caption{{{latex_text(table.title)}.}}\label{{tab:{table.name}}}")
    for block in table.blocks:
        names, values = shown_columns(block)
        ranks = block.ranks()
        lines += [rf"\par\smallskip\textit{{{latex_text(block.title)}}}\par\smallskip"]
        lines += [r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"]
        lines += [rf"\begin{{tabular}}{{{'l' * len(names)}{'r' * len(values)}}}", r"\toprule"]
        lines += [" & ".join(map(latex_text, [*names, *values])) + r" \\", r"\midrule"]
        for number, row in enumerate(block.rows):
            cells = [latex_text(row.names.get(name, "")) for name in names]
            for column in values:
                cell = row.cells.get(column, Cell())
                note = rf"\textsuperscript{{{notes[cell.note]}}}" if cell.note else ""
                cells.append(marks[ranks.get((number, column), 0)] % latex_text(cell.text) + note)
            lines.append(" & ".join(cells) + r" \\")
        lines += [r"\bottomrule", r"\end{tabular}}"]
    lines.append(r"\par\smallskip\raggedright\footnotesize")
    lines += [latex_text(note) + r"\par" for note in table.footnotes]
    lines += [rf"\textsuperscript{{{number}}} {latex_text(note)}\par" for note, number in notes.items()]
    lines.append(r"\end{table*}")
    return "\n".join(lines) + "\n"
