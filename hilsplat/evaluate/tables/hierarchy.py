"""Queries at three levels and the scored frames: Hi-LERF, Hi-3DOVS and their synthetic stand-ins."""

from functools import partial
from typing import TYPE_CHECKING

from hilsplat.evaluate.protocols.cards import LEVEL_GIVEN, VIEW_CONSISTENCY
from hilsplat.evaluate.protocols.totals import share_above, table_value
from hilsplat.evaluate.tables.measured import (
    kind_and_title,
    level_cells,
    measured_blocks,
    same_row,
    with_seeds,
)
from hilsplat.evaluate.tables.rows import Block, Cell, Row, Table
from hilsplat.evaluate.tables.sources import Sources

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (
    "L1",
    "L2",
    "L3",
    "Avg",
    "Acc@0.25",
    "HC containment",
    "HC literal",
    "HC anchored",
    "View consistency",
    "Avg, best threshold",
    "Pairs",
)


def hierarchy_table(sources: Sources) -> Table:
    """Build the table of mIoU at three levels, hierarchical consistency and view consistency."""
    blocks = [
        sources.reported(data, rename=partial(column_of_data, data)) for data in ("Hi-LERF", "Hi-3DOVS")
    ]
    scores = with_seeds(sources.scores)

    def cells_of(part: "pd.DataFrame") -> dict[str, Cell]:
        ious = part[part["metric"] == "iou"]
        cells = {
            **level_cells(part),
            "Acc@0.25": Cell.percent(share_above(part, "iou", 0.25)),
            "HC containment": Cell.percent(table_value(part, "hc_containment")),
            "HC literal": Cell.percent(table_value(part, "hc_literal")),
            "HC anchored": Cell.percent(table_value(part, "hc_anchored")),
            "Avg, best threshold": level_cells(part, "best_threshold_iou")["Avg"],
            "Pairs": Cell(str(len(ious)), float(len(ious))) if len(ious) else Cell(),
        }
        if part["protocol"].iloc[0].startswith(LEVEL_GIVEN.full_name):
            same = same_row(scores, part, (VIEW_CONSISTENCY.full_name,))
            cells["View consistency"] = level_cells(same, "view_consistency")["Avg"]
        return cells

    blocks += measured_blocks(
        sources,
        ("hierarchy/",),
        cells_of,
        lambda _: COLUMNS,
        frozenset({"HC literal", "Avg, best threshold", "Pairs"}),
    )
    footnotes = (
        "mIoU in %: mean over (view, text) pairs of a scene, then over scenes; Avg is the mean of L1 to L3.",
        "HC containment: share of the child inside the parent (the paper's wording), mean over the children "
        "of a parent, then over parents: 100 for perfect nesting, 50 in a view without subparts. HC literal: "
        "share of the parent covered by the child (the printed formula; perfect masks "
        "score low). HC anchored: share of the child inside the annotated parent. The row of the "
        "annotations gives what perfect masks would score.",
        "A path of texts asks for whole > part > subpart: more information than the paper's protocol gives.",
        "The field and the tree answer each view by what that view shows: only nodes visible in it compete. "
        "Scene-wide: all nodes of the scene compete, and one answer in 3D serves all views.",
        "View consistency: of the surface points visible in two neighbouring views, IoU of those inside the "
        "answer of one view and of the other, by exact geometry, level given; mean over the texts of a "
        "level, then over levels. Texts that neither view answers there are left out. It measures "
        "consistency, not correctness.",
        "Avg, best threshold: the threshold of every map is chosen with the truth: a diagnostic.",
    )
    return sources.finished("hierarchy", "Queries at three levels", blocks, footnotes)


def column_of_data(data: str, column: str) -> str | None:
    """Return the name of a reported column in the block of a data set; None in the other block."""
    if not column.startswith(f"{data} "):
        return None
    return column.removeprefix(f"{data} ").replace("HC", "HC (reading not stated)")


def frames_table(sources: Sources, name: str, data: str) -> Table:
    """Build a table of the paper's frames, and of the views queried at levels with their number of texts."""
    blocks = [sources.reported(data, families=False)]
    for dataset, views in asked_views(sources).items():
        rows = [
            Row(
                {"Frame": str(number + 1)},
                {scene: Cell(listed[number]) for scene, listed in views.items() if number < len(listed)},
                None,
            )
            for number in range(max(map(len, views.values())))
        ]
        blocks.append(Block(*kind_and_title(dataset), tuple(rows), tuple(sorted(views))))
    footnotes = ("Measured rows: views that were scored, with the number of texts asked at levels.",)
    return sources.finished(name, f"{data}: frames", blocks, footnotes)


def asked_views(sources: Sources) -> dict[str, dict[str, list[str]]]:
    """Return the views queried at levels by data set and scene, each with its number of texts."""
    asked: dict[tuple[str, str, str], set] = {}
    for row in sources.scores.itertuples():
        if row.metric == "iou" and row.protocol.startswith(LEVEL_GIVEN.full_name):
            asked.setdefault((row.dataset, row.scene, row.view), set()).add((row.query, row.level))
    found: dict[str, dict[str, list[str]]] = {}
    for (dataset, scene, view), texts in sorted(asked.items()):
        name = view.rpartition(".")[0] or view
        found.setdefault(dataset, {}).setdefault(scene, []).append(f"{name} ({len(texts)} texts)")
    return found
