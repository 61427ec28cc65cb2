"""Ablations of the method's parts, and the sweeps over theta, Omega and pruning."""

import math
import statistics
from dataclasses import replace
from typing import TYPE_CHECKING

from hilsplat.datasets.sources import LEVELLED
from hilsplat.evaluate.tables import measured
from hilsplat.evaluate.tables.kinds import TableKind
from hilsplat.evaluate.tables.rows import Block, Cell, Sources

if TYPE_CHECKING:
    import pandas as pd


def ablation_blocks(kind: TableKind, sources: Sources) -> list[Block]:
    """Return a row per variant and method, the ablation's protocols side by side."""
    blocks = measured.measured_blocks(kind, sources, component_cells, over_seeds=against_default)
    return [replace(block, columns=tuple(block.filled_columns())) for block in blocks]


def component_cells(scores: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return the values of one row from its scores under all protocols.

    Hi-LERF and Hi-3DOVS label images of LERF and 3D-OVS; the other columns use the labels of LERF and 3D-OVS.
    """
    dataset = part.iloc[0]["dataset"]
    lerf, ovs3d = ("lerf_ovs", "3d_ovs") if dataset in LEVELLED else (dataset, dataset)
    flat = measured.same_row(scores, part, ("lerf/langsplat@", "lerf/tree-nodes@"), lerf)
    ovs = measured.same_row(scores, part, ("3d-ovs/langsplat@",), ovs3d)
    levels = measured.level_cells(part)
    average = levels.pop("Avg")
    return {
        "LERF localization": measured.percent(flat, "localization_box"),
        "LERF mIoU": measured.percent(flat, "iou"),
        "3D-OVS mIoU": measured.percent(ovs, "iou"),
        **levels,
        "Hi-LERF mIoU": average,
        "Hi-LERF HC": measured.percent(part, "hc_containment"),
        "Avg, best threshold": measured.level_cells(part, "best_threshold_iou")["Avg"],
    }


def against_default(scores: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return a row's mIoU over all seeds minus the default field's mIoU, paired by scene.

    Scenes differ more than rows do, so the spread of paired differences shows whether one row is better.
    """
    first = part.iloc[0]
    default = (scores["variant"] == "default") & (scores["method"] == "field")
    for key in ("dataset", "masks", "protocol"):
        default &= scores[key] == first[key]
    cell = Cell()
    if (first["variant"], first["method"]) != ("default", "field"):
        ours, others = (measured.level_averages_of_scenes(rows, "iou") for rows in (part, scores[default]))
        cell = mean_difference(list(100 * (ours - others).dropna()))
    return {"against default field": cell}


def mean_difference(differences: list[float]) -> Cell:
    """Return the mean with its sign and, for several differences, its standard error."""
    if not differences:
        return Cell()
    mean = statistics.fmean(differences)
    if len(differences) == 1:
        return Cell(f"{mean:+.1f}", mean)
    error = statistics.stdev(differences) / math.sqrt(len(differences))
    return Cell(f"{mean:+.1f} ± {error:.1f}", mean, spread=error)
