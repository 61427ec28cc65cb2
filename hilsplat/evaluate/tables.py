"""The paper's tables: what it reports, what was measured, what a synthetic stand-in gave.

The three kinds stand in blocks of their own and are never ranked against each other. Imports neither
torch nor anything heavy, so that a table is built in about a second.
"""

import csv
import html
import io
import logging
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from hilsplat.base.artifacts import write_text
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import LEVELS
from hilsplat.evaluate.protocols.cards import ANNOTATIONS, LEVEL_AUTO, LEVEL_GIVEN, PATH, card_of
from hilsplat.evaluate.scores import made_from_truth, read_scores

if TYPE_CHECKING:
    import pandas as pd

logger = logging.getLogger(__name__)

PUBLISHED_COLUMNS = ("method", "family", "column", "value", "note")
SYNTHETIC = "synthetic"
"""Data sets whose name begins so are stand-ins."""

ANSWERS = {
    "field": "rendered field",
    "tree": "tree nodes",
    "tree-path": "tree nodes, path",
    "truth": "annotations",
}
"""How tables name the methods of score rows, in the order of their rows."""

PROTOCOLS = {
    LEVEL_GIVEN.full_name: "level given",
    LEVEL_AUTO.full_name: "level chosen",
    PATH.full_name: "path of texts",
    ANNOTATIONS.full_name: "reference",
}
"""How tables name protocols; others keep their name."""

STAND_IN_NOTE = (
    "Rows of a synthetic stand-in are measured on generated scenes with the models named under Masks. "
    "They show how the parts of the method compare with each other and are not comparable with reported "
    "rows."
)

TRUE_MASKS = "diagnostic, true masks: "
"""Before the method's name in rows whose masks were made from true labels."""

TRUE_MASKS_NOTE = (
    "Rows that begin with 'diagnostic, true masks' were given masks made from the true labels, with the "
    "faults named under Masks. They are no results and are ranked with nothing; they tell errors of the "
    "method from errors of the segmenter."
)


@dataclass(frozen=True)
class Cell:
    """One value of a table.

    Attributes:
        text: as it is shown.
        value: as a number, where it is one; ranking needs it.
        note: footnote, empty where there is none.
    """

    text: str = "-"
    value: float | None = None
    note: str = ""

    @staticmethod
    def percent(value: float) -> "Cell":
        """A share in [0, 1] as a percentage with one decimal; nan is a dash."""
        return Cell() if value != value else Cell(f"{100 * value:.1f}", 100 * value)

    @staticmethod
    def printed(text: str, note: str = "") -> "Cell":
        """A value as the paper prints it."""
        number = re.fullmatch(r"-?\d+(\.\d+)?", text)
        return Cell(text, float(text) if number else None, note)


@dataclass(frozen=True)
class Row:
    """One method: names on the left, values by column, and what it may be ranked with."""

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
        rows: in the order of display.
        columns: value columns, in the order of display.
        lower_is_better: columns in which the smallest value is best.
        unranked: columns in which nothing is best.
    """

    kind: str
    data: str
    title: str
    rows: tuple[Row, ...]
    columns: tuple[str, ...]
    lower_is_better: frozenset[str] = frozenset()
    unranked: frozenset[str] = frozenset()

    def ranks(self) -> dict[tuple[int, str], int]:
        """(row, column) -> 1, 2, 3 for the three best values of rows that are ranked together.

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
                    # What is shown is what is compared, so equal texts get equal marks.
                    groups.setdefault(row.ranked_with, {})[number] = float(cell.text)
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
        """Cell notes, numbered in the order of reading."""
        notes: dict[str, int] = {}
        for block in self.blocks:
            for row in block.rows:
                for column in block.columns:
                    note = row.cells.get(column, Cell()).note
                    if note:
                        notes.setdefault(note, len(notes) + 1)
        return notes


def run_table(
    name: str, scores: Sequence[Path], published: Path, labels: Mapping[str, str], out: Path
) -> None:
    """Build one table and write it as CSV, Markdown, LaTeX and HTML.

    Args:
        name: a key of `BUILDERS`.
        scores: `scores.csv` of every scene and variant that the table shows.
        published: the paper's values: `config/published/<name>.csv`.
        labels: variant -> how the table names it; others keep their name.
        out: the CSV; `.md`, `.tex` and `.html` are written beside it.

    Raises:
        ArtifactError: the table is unknown, or a file is missing or has other columns.
    """
    if name not in BUILDERS:
        raise ArtifactError(f"there is no table {name!r}", expected=f"one of {', '.join(BUILDERS)}")
    table = BUILDERS[name](read_published(published), read_scores(scores), labels)
    write_table(table, out)
    rows = sum(len(block.rows) for block in table.blocks)
    logger.info("table %s: %d blocks, %d rows", name, len(table.blocks), rows)


def write_table(table: Table, out: Path) -> None:
    """Write all four forms; the same table gives the same bytes."""
    out = Path(out)
    write_text(out.with_suffix(".md"), as_markdown(table))
    write_text(out.with_suffix(".tex"), as_latex(table))
    write_text(out.with_suffix(".html"), as_html(table))
    write_text(out, as_csv(table))


def read_published(path: Path) -> list[dict[str, str]]:
    """Rows of a published table: method, family, column, value, note.

    Raises:
        ArtifactError: the file is missing or has other columns.
    """
    try:
        with Path(path).open(encoding="utf-8", newline="") as stream:
            reader = csv.DictReader(stream)
            rows = list(reader)
    except FileNotFoundError as error:
        raise ArtifactError(f"{path} is missing", fix="restore it from the repository") from error
    if tuple(reader.fieldnames or ()) != PUBLISHED_COLUMNS:
        raise ArtifactError(
            f"{path} has other columns",
            expected=", ".join(PUBLISHED_COLUMNS),
            found=", ".join(reader.fieldnames or ()),
        )
    return rows


# --- blocks -----------------------------------------------------------------------------------------


def reported_block(
    published: Iterable[Mapping[str, str]],
    data: str,
    title: str,
    rename: Callable[[str], str | None] = lambda column: column,
    families: bool = True,
) -> Block:
    """The paper's rows.

    Args:
        published: rows of a published table.
        data: data set.
        title: heading.
        rename: maps the paper's columns to ours, and those to leave out to None.
        families: show the family of each method.
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


def measured_blocks(
    scores: "pd.DataFrame",
    labels: Mapping[str, str],
    protocols: Callable[[str], bool],
    cells_of: Callable[["pd.DataFrame"], dict[str, Cell]],
    columns_of: Callable[["pd.DataFrame"], Sequence[str]],
    unranked: frozenset[str] = frozenset(),
    ranked_by_protocol: bool = True,
) -> list[Block]:
    """One block per data set; one row per variant, method, masks and protocol.

    Args:
        scores: rows of `scores.csv`.
        labels: variant -> name.
        protocols: says which protocols make a row.
        cells_of: values of a row, from the scores of one variant, method, masks and protocol.
        columns_of: value columns, from the scores of a data set.
        unranked: columns in which nothing is best.
        ranked_by_protocol: rows of different protocols are not ranked against each other.
    """
    blocks = []
    order = ["default", *labels]
    for data, of_data in scores.groupby("dataset", sort=True):
        rows = []
        wanted = of_data[of_data["protocol"].map(protocols)]
        keys = ["variant", "masks", "method", "protocol"]
        for (variant, masks, method, protocol), part in wanted.groupby(keys, sort=True):
            names = {
                "Method": labels.get(variant, variant),
                "Answer": ANSWERS.get(method, method),
                "Masks": masks if method != "truth" else "-",
                "Protocol": PROTOCOLS.get(protocol, protocol),
            }
            if method == "truth":
                names["Method"] = "annotations"
            elif made_from_truth(masks):
                names["Method"] = TRUE_MASKS + names["Method"]
            place = (
                made_from_truth(masks),
                list(PROTOCOLS).index(protocol) if protocol in PROTOCOLS else -1,
                order.index(variant) if variant in order else len(order),
                variant,
                list(ANSWERS).index(method) if method in ANSWERS else len(ANSWERS),
                masks,
                protocol,
            )
            group = protocol if ranked_by_protocol else ""
            ranked = method != "truth" and not made_from_truth(masks)
            rows.append((place, Row(names, cells_of(part), group if ranked else None)))
        rows = [row for _, row in sorted(rows, key=lambda item: item[0])]
        seen: dict[tuple, None] = {}
        distinct = []
        for row in rows:  # the annotations' own row is the same for every variant
            key = (*row.names.values(), *(cell.text for cell in row.cells.values()))
            if key not in seen:
                seen[key] = None
                distinct.append(row)
        if distinct:
            blocks.append(
                Block(
                    *kind_and_title(str(data)), tuple(distinct), tuple(columns_of(wanted)), unranked=unranked
                )
            )
    return blocks


def kind_and_title(dataset: str) -> tuple[str, str, str]:
    """Kind, data set and heading of measured rows."""
    if dataset.startswith(SYNTHETIC):
        return "synthetic stand-in", dataset, f"Measured on a synthetic stand-in ({dataset}); not comparable"
    return "measured", dataset, f"Measured on {dataset}"


def scene_mean(part: "pd.DataFrame", metric: str, level: str | None = None) -> float:
    """Mean over the rows of each scene, then over scenes; nan where there is none."""
    rows = part[part["metric"] == metric]
    if level is not None:
        rows = rows[rows["level"] == level]
    if rows.empty:
        return float("nan")
    return float(rows.groupby("scene", sort=True)["value"].mean().mean())


def level_cells(part: "pd.DataFrame", metric: str = "iou") -> dict[str, Cell]:
    """L1, L2, L3 and Avg, the mean of the levels that have pairs."""
    values = [scene_mean(part, metric, level.label) for level in LEVELS]
    present = [value for value in values if value == value]
    average = sum(present) / len(present) if present else float("nan")
    names = [f"L{int(level)}" for level in LEVELS]
    return {**dict(zip(names, map(Cell.percent, values), strict=True)), "Avg": Cell.percent(average)}


# --- tables -----------------------------------------------------------------------------------------


def hierarchy_table(published: list, scores: "pd.DataFrame", labels: Mapping[str, str]) -> Table:
    """mIoU at three levels and hierarchical consistency (paper: Hi-LERF and Hi-3DOVS)."""
    blocks = []
    for data in ("Hi-LERF", "Hi-3DOVS"):

        def rename(column: str, data: str = data) -> str | None:
            if not column.startswith(f"{data} "):
                return None
            return column.removeprefix(f"{data} ").replace("HC", "HC (reading not stated)")

        blocks.append(reported_block(published, data, f"Reported in the paper: {data}", rename))

    def cells_of(part: "pd.DataFrame") -> dict[str, Cell]:
        ious = part[part["metric"] == "iou"]
        share = ious.assign(value=(ious["value"] > 0.25).astype(float))
        best = level_cells(part, "best_threshold_iou")["Avg"]
        return {
            **level_cells(part),
            "Acc@0.25": Cell.percent(scene_mean(share, "iou")),
            "HC containment": Cell.percent(scene_mean(part, "hc_containment")),
            "HC literal": Cell.percent(scene_mean(part, "hc_literal")),
            "HC anchored": Cell.percent(scene_mean(part, "hc_anchored")),
            "Avg, best threshold": best,
            "Pairs": Cell(str(len(ious)), float(len(ious))) if len(ious) else Cell(),
        }

    columns = ["L1", "L2", "L3", "Avg", "Acc@0.25", "HC containment", "HC literal", "HC anchored"]
    columns += ["Avg, best threshold", "Pairs"]
    blocks += measured_blocks(
        scores,
        labels,
        lambda protocol: protocol.startswith("hierarchy/"),
        cells_of,
        lambda _: columns,
        frozenset({"HC literal", "Avg, best threshold", "Pairs"}),
    )
    footnotes = (
        "mIoU in %: mean over (view, text) pairs of a scene, then over scenes; Avg is the mean of L1 to L3.",
        "HC containment: share of the child inside the parent (the paper's wording; 100 for perfect "
        "nesting). HC literal: share of the parent covered by the child (the printed formula; perfect masks "
        "score low). HC anchored: share of the child inside the annotated parent. The row of the "
        "annotations gives what perfect masks would score.",
        "A path of texts asks whole > part > subpart: more information than the paper's protocol gives.",
        "Avg, best threshold: the threshold of every map is chosen with the truth; a diagnostic, no result.",
    )
    return finished("hierarchy", "Queries at three levels", blocks, footnotes)


def lerf_table(published: list, scores: "pd.DataFrame", labels: Mapping[str, str]) -> Table:
    """Segmentation and localization per scene (paper: LERF)."""
    blocks = [reported_block(published, "LERF", "Reported in the paper: LERF")]
    metrics = {"mIoU": "iou", "mBIoU": "boundary_iou", "localization": "localization_box"}

    def cells_of(part: "pd.DataFrame") -> dict[str, Cell]:
        cells = {}
        for name, metric in metrics.items():
            for scene, of_scene in part.groupby("scene", sort=True):
                cells[f"{scene} {name}"] = Cell.percent(scene_mean(of_scene, metric))
            cells[f"Average {name}"] = Cell.percent(scene_mean(part, metric))
        return cells

    def columns_of(of_data: "pd.DataFrame") -> list[str]:
        scenes = [*sorted(set(of_data["scene"])), "Average"]
        segmentation = [f"{scene} {name}" for scene in scenes for name in ("mIoU", "mBIoU")]
        return segmentation + [f"{scene} localization" for scene in scenes]

    blocks += measured_blocks(
        scores,
        labels,
        lambda protocol: protocol.startswith("lerf/"),
        cells_of,
        columns_of,
        ranked_by_protocol=False,
    )
    footnotes = (
        "All in %. mIoU and mBIoU are means over (view, text) pairs of a scene; Average is the mean of the "
        "scenes. Localization: the point of highest smoothed relevancy lies in a box of the text.",
        "lerf/langsplat: mean filter (30 px at a height of 730, scaled), min-max above 0.7, 7 x 7 majority, "
        "level of the highest relevancy. lerf/tree-nodes: tree nodes, level chosen by the tree.",
        "*: reproduced by the paper's authors; other reported rows come from the methods' own papers.",
    )
    return finished("lerf", "Segmentation and localization", blocks, footnotes)


def ablation_table(published: list, scores: "pd.DataFrame", labels: Mapping[str, str]) -> Table:
    """What each part of the method adds (paper: ablation, theta and Omega)."""
    blocks = []
    for family in dict.fromkeys(entry["family"] for entry in published):
        of_family = [entry for entry in published if entry["family"] == family]
        filled = {entry["column"] for entry in of_family if entry["value"] != "-"}
        blocks.append(
            reported_block(
                of_family,
                "LERF, 3D-OVS, Hi-LERF",
                f"Reported in the paper: {family.lower()}",
                lambda column, filled=filled: column if column in filled else None,
                families=False,
            )
        )
    flat = scores[scores["protocol"].str.startswith(("lerf/langsplat@", "lerf/tree-nodes@"))]

    def cells_of(part: "pd.DataFrame") -> dict[str, Cell]:
        first = part.iloc[0]
        same = flat[
            (flat["dataset"] == first["dataset"])
            & (flat["variant"] == first["variant"])
            & (flat["masks"] == first["masks"])
            & (flat["method"] == first["method"])
        ]
        return {
            "Localization": Cell.percent(scene_mean(same, "localization_box")),
            **level_cells(part),
            "HC containment": Cell.percent(scene_mean(part, "hc_containment")),
            "Avg, best threshold": level_cells(part, "best_threshold_iou")["Avg"],
        }

    columns = ["Localization", "L1", "L2", "L3", "Avg", "HC containment", "Avg, best threshold"]
    blocks += measured_blocks(
        scores[scores["method"] != "truth"],
        labels,
        lambda protocol: card_of(protocol) in (LEVEL_GIVEN, PATH),
        cells_of,
        lambda _: columns,
        frozenset({"Avg, best threshold"}),
    )
    footnotes = (
        "All in %. Measured rows: the level is given, except for localization, where it is chosen. A row "
        "thus tells the parts of the method apart, and not how well levels are chosen.",
        "Initial-2D: levels of the 2D masks. 3D-HC: 3D hierarchical clustering. Instance, Part: contrastive "
        "losses.",
    )
    return finished("ablation", "Ablation", blocks, footnotes)


def reported_table(name: str, title: str) -> Callable[..., Table]:
    """Builder of a table of which only the paper's rows exist."""

    def build(published: list, scores: "pd.DataFrame", labels: Mapping[str, str]) -> Table:
        return finished(name, title, [reported_block(published, title, "Reported in the paper")], ())

    return build


def efficiency_table(published: list, scores: "pd.DataFrame", labels: Mapping[str, str]) -> Table:
    """Time and memory as the paper reports them; measured times are `efficiency.run_efficiency`'s."""
    blocks = []
    for family in dict.fromkeys(entry["family"] for entry in published):
        block = reported_block(
            [entry for entry in published if entry["family"] == family],
            "LERF, 3D-OVS, Hi-LERF",
            f"Reported in the paper: {'one RTX 3090' if family == 'RTX 3090' else family.lower()}",
            families=False,
        )
        lower = frozenset(column for column in block.columns if column.endswith(("(min)", "(GB)", "(s)")))
        blocks.append(Block(block.kind, block.data, block.title, block.rows, block.columns, lower))
    return finished("efficiency", "Time and memory, as reported", blocks, ())


def finished(name: str, title: str, blocks: Iterable[Block], footnotes: Sequence[str]) -> Table:
    """A table with the warnings that its rows need."""
    blocks = tuple(blocks)
    warnings = []
    if any(block.kind == "synthetic stand-in" for block in blocks):
        warnings.append(STAND_IN_NOTE)
    if any(made_from_truth(row.names.get("Masks", "")) for block in blocks for row in block.rows):
        warnings.append(TRUE_MASKS_NOTE)
    return Table(name, title, blocks, (*warnings, *footnotes))


BUILDERS: dict[str, Callable[..., Table]] = {
    "hierarchy": hierarchy_table,
    "lerf": lerf_table,
    "ablation": ablation_table,
    "efficiency": efficiency_table,
    "3dovs": reported_table("3dovs", "3D-OVS: segmentation"),
    "replica": reported_table("replica", "Replica: semantic segmentation"),
    "scannet": reported_table("scannet", "ScanNet and ScanNet200"),
    "waymo": reported_table("waymo", "Waymo: 3D semantic segmentation"),
}


# --- forms ------------------------------------------------------------------------------------------


def shown_columns(block: Block) -> tuple[list[str], list[str]]:
    """Name and value columns of a block; those without any entry are left out."""
    names = list(dict.fromkeys(name for row in block.rows for name in row.names))
    values = [
        column
        for column in block.columns
        if any(row.cells.get(column, Cell()).text != "-" for row in block.rows)
    ]
    return names, values


def as_csv(table: Table) -> str:
    """All blocks in one sheet; measured values with two decimals, reported ones as printed."""
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
    return f"{cell.value:.2f}"


def as_markdown(table: Table) -> str:
    """Best bold, second underlined, third in italics."""
    marks = {1: "**{}**", 2: "<u>{}</u>", 3: "*{}*", 0: "{}"}
    notes = table.numbered_notes()
    lines = [f"# {table.title}", ""]
    for block in table.blocks:
        names, values = shown_columns(block)
        ranks = block.ranks()
        lines += [f"## {block.title}", "", "| " + " | ".join([*names, *values]) + " |"]
        lines.append("|" + "---|" * len(names) + "---:|" * len(values))
        for number, row in enumerate(block.rows):
            cells = [row.names.get(name, "").replace("|", "\\|").replace("*", "\\*") for name in names]
            for column in values:
                cell = row.cells.get(column, Cell())
                note = f"<sup>{notes[cell.note]}</sup>" if cell.note else ""
                cells.append(marks[ranks.get((number, column), 0)].format(cell.text) + note)
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    lines += ["Best three in a block and protocol: **best**, <u>second</u>, *third*.", ""]
    lines += [f"- {note}".replace("*:", "\\*:") for note in table.footnotes]
    lines += [f"- <sup>{number}</sup> {note}" for note, number in notes.items()]
    return "\n".join(lines).rstrip() + "\n"


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
}


def latex_text(text: str) -> str:
    """Escape what LaTeX would read as commands."""
    return "".join(LATEX_SPECIAL.get(letter, letter) for letter in text)


def as_latex(table: Table) -> str:
    """booktabs, footnotes as paragraphs below. Best bold, second underlined, third italic."""
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
    """A fragment for the report; best, second and third coloured as in the paper."""
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
