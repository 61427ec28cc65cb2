"""Ablations of the method's parts, and the sweeps over theta, Omega and pruning."""

import math
import statistics
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from hilsplat.datasets.sources import LEVELLED
from hilsplat.evaluate.tables import measured
from hilsplat.evaluate.tables.kinds import TableKind
from hilsplat.evaluate.tables.rows import Block, Cell, Sources

if TYPE_CHECKING:
    import pandas as pd


def ablation_blocks(kind: TableKind, sources: Sources) -> list[Block]:
    """Return a row per variant and method, the ablation's protocols side by side."""
    over_seeds = partial(step_cells, kind.steps, sources.labels)
    blocks = measured.measured_blocks(kind, sources, component_cells, over_seeds)
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


def step_cells(
    steps: Mapping[str, str], labels: Mapping[str, str], scores: "pd.DataFrame", part: "pd.DataFrame"
) -> dict[str, Cell]:
    """Return the row that a row extends, and its mean differences from it in mIoU and HC.

    Scenes and codes differ more than rows do, so differences are paired by scene and seed or, if the rows
    have different seeds, by scene, with means over seeds. Errors count the pairs as independent.
    """
    first = part.iloc[0]
    before = steps.get(first["variant"], "default")
    others = scores[(scores["variant"] == before) & (scores["method"] == "field")]
    for key in ("dataset", "masks", "protocol"):
        others = others[others[key] == first[key]]
    if others.empty or (first["variant"], first["method"]) == (before, "field"):
        return {}
    others = measured.of_comparable_seeds(others)  # as are those of `part`
    pairs = ["scene", "seed"] if set(part["seed"]) == set(others["seed"]) else ["scene"]
    cells = {"step from": Cell(measured.row_name(before, "field", labels))}
    for name, metric in (("mIoU step", "iou"), ("HC step", "hc_containment")):
        averages, other = (measured.level_averages(rows, metric, pairs) for rows in (part, others))
        cells[name] = mean_difference(list(100 * (averages - other).dropna()))
    return cells


def mean_difference(differences: list[float]) -> Cell:
    """Return the mean with its sign and, for several differences, its standard error."""
    if not differences:
        return Cell()
    mean = statistics.fmean(differences)
    text = f"{round(mean, 1) + 0.0:+.1f}"  # never "-0.0"
    if len(differences) == 1:
        return Cell(text, mean)
    error = statistics.stdev(differences) / math.sqrt(len(differences))
    return Cell(f"{text} ± {error:.1f}", mean, spread=error)
