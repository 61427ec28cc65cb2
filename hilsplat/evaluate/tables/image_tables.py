"""Measured rows of labelled images: LERF, 3D-OVS, queries at three levels, and the scored frames."""

from typing import TYPE_CHECKING, Any

from hilsplat.base.tables import counted
from hilsplat.evaluate.metrics.hierarchy import READINGS
from hilsplat.evaluate.protocols.cards import LEVEL_GIVEN, VIEW_CONSISTENCY
from hilsplat.evaluate.tables.kinds import TABLES, TableKind
from hilsplat.evaluate.tables.measured import kind_and_title, level_cells, percent, same_row, scene_cells
from hilsplat.evaluate.tables.rows import Block, Cell, Row, Sources

if TYPE_CHECKING:
    import pandas as pd


def lerf_cells(_: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    return scene_cells(part, {"mIoU": "iou", "mBIoU": "boundary_iou", "localization": "localization_box"})


def ovs_cells(_: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return mIoU per scene, and mIoU and accuracy over the scenes of the paper."""
    cells = scene_cells(part, {"mIoU": "iou"})
    if (part["dataset"] == "3d_ovs").all():
        part = part[part["scene"].isin(TABLES["3dovs"].averaged)]
    overall = {"Overall mIoU": "iou", "Overall accuracy": "pixel_accuracy"}
    return cells | {name: percent(part, metric) for name, metric in overall.items()}


def hierarchy_cells(scores: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return mIoU at three levels, hierarchical consistency and view consistency."""
    ious = part[part["metric"] == "iou"]
    above = ious.assign(value=(ious["value"] > 0.25).astype(float))
    cells = {
        **level_cells(part),
        "Acc@0.25": percent(above, "iou"),
        **{f"HC {reading}": percent(part, f"hc_{reading}") for reading in READINGS},
        "Avg, best threshold": level_cells(part, "best_threshold_iou")["Avg"],
        "Pairs": Cell.count(len(ious)) if len(ious) else Cell(),
    }
    if part["protocol"].iloc[0].startswith(LEVEL_GIVEN.full_name):
        consistency = same_row(scores, part, (VIEW_CONSISTENCY.full_name,))
        cells["View consistency"] = level_cells(consistency, "view_consistency")["Avg"]
    return cells


def frames_blocks(_: TableKind, sources: Sources) -> list[Block]:
    """Return the views queried at levels, with the number of texts in each."""
    texts: dict[tuple[str, str, str], set[Any]] = {}
    for row in sources.scores.itertuples():
        if row.metric == "iou" and row.protocol.startswith(LEVEL_GIVEN.full_name):
            texts.setdefault((row.dataset, row.scene, row.view), set()).add((row.query, row.level))
    views: dict[str, dict[str, list[str]]] = {}
    for (dataset, scene, view), of_view in sorted(texts.items()):
        cell = f"{view.rpartition('.')[0] or view} ({counted(len(of_view), 'text')})"
        views.setdefault(dataset, {}).setdefault(scene, []).append(cell)
    blocks = []
    for dataset, of_scenes in views.items():
        rows = []
        for number in range(max(map(len, of_scenes.values()))):
            cells = {scene: Cell(names[number]) for scene, names in of_scenes.items() if number < len(names)}
            rows.append(Row({"Frame": str(number + 1)}, cells, None))
        blocks.append(Block(*kind_and_title(dataset), tuple(rows), tuple(sorted(of_scenes))))
    return blocks
