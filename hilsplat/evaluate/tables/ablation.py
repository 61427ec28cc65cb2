"""Ablations of the method's parts, and the sweeps over theta, Omega and pruning."""

import math
import statistics
from dataclasses import replace
from typing import TYPE_CHECKING

from hilsplat.datasets.sources import LEVELLED
from hilsplat.evaluate.protocols.cards import LEVEL_GIVEN, PATH
from hilsplat.evaluate.tables import measured
from hilsplat.evaluate.tables.rows import Cell, Sources, Table

if TYPE_CHECKING:
    import pandas as pd

PAPER_DATA = "LERF, 3D-OVS, Hi-LERF"
"""Data sets of the paper's ablations."""

AGAINST = "against default field"
COLUMNS = (
    *("LERF localization", "LERF mIoU", "3D-OVS mIoU", "L1", "L2", "L3"),
    *("Hi-LERF mIoU", "Hi-LERF HC", "Avg, best threshold", AGAINST),
)

COLUMNS_NOTE = (
    "All values in %. Measured columns have the paper's names; on the stand-in, LERF and 3D-OVS denote their "
    "protocols (lerf/langsplat or lerf/tree-nodes, level chosen; 3d-ovs/langsplat), and Hi-LERF denotes "
    "hierarchy/level-given: mIoU is the mean of L1 to L3, and HC uses the containment reading. The level is "
    "given, so a row measures the components of the method, not how well levels are chosen. "
    f'"{AGAINST}": Hi-LERF mIoU minus that of the default field, paired by scene; mean and standard error '
    "over the scenes."
)


ABLATIONS = {
    "ablation": (
        "Ablation",
        "ablation",
        "Initial-2D: 2D mask levels from the coverage tree. 3D-HC: 3D hierarchical clustering (L_h). "
        "Instance, Part: contrastive losses (L_ins, L_part). docs/paper.md states our reading of each.",
    ),
    "components": (
        "Parts of the default field",
        "parts",
        "Rows name the enabled losses; d is the size of a latent.",
    ),
    "theta": (
        "Influence of the coverage threshold theta",
        "coverage threshold",
        "theta determines which masks of a view are nested. Rows that follow the paper take levels from the "
        "coverage tree (masks.levels: tree), so theta moves masks between levels. With levels from SAM's "
        "heads, theta affects fields only through L_ins and L_part, and does not affect semantic trees.",
    ),
    "omega": (
        "Influence of the similarity degree Omega",
        "similarity degrees",
        "Omega appears only in L_ins. Rows that follow the paper use lambda_1 = exp(-6) and "
        "lambda_2 = exp(-5); with 1e-6 and 1e-5, all rows are equal.",
    ),
}
"""Ablation (the paper's, ours, sweeps) -> its title, the heading of the reported rows, and a note."""


def ablation_table(sources: Sources, name: str) -> Table:
    """Build a table in `ABLATIONS`: a row per variant and method, the ablation's protocols side by side."""
    title, reported, note = ABLATIONS[name]
    methods = ("field",) if name in ("theta", "omega") else ("field", "tree", "tree-path")
    scores = measured.with_seeds(sources.scores)
    blocks = measured.measured_blocks(
        replace(sources, scores=sources.scores[sources.scores["method"].isin(methods)]),
        (f"{LEVEL_GIVEN.name}@", f"{PATH.name}@"),
        lambda part: component_cells(scores, part),
        lambda _: COLUMNS,
        frozenset({"Avg, best threshold", AGAINST}),
        over_seeds=lambda part: {AGAINST: against_default(scores, part)},
    )
    filled = [replace(block, columns=tuple(block.filled_columns())) for block in blocks]
    reported_rows = sources.reported(PAPER_DATA, reported, families=False)
    return sources.finished(name, title, [reported_rows, *filled], (COLUMNS_NOTE, note))


def component_cells(scores: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return the values of one row from its scores under all protocols.

    Hi-LERF and Hi-3DOVS label images of LERF and 3D-OVS; the other columns use the labels of LERF and 3D-OVS.
    """
    own = part.iloc[0]["dataset"]
    lerf, ovs3d = ("lerf_ovs", "3d_ovs") if own in LEVELLED else (own, own)
    flat = measured.same_row(scores, part, ("lerf/langsplat@", "lerf/tree-nodes@"), lerf)
    ovs = measured.same_row(scores, part, ("3d-ovs/langsplat@",), ovs3d)
    levels = measured.level_cells(part)
    return {
        "LERF localization": Cell.percent(measured.table_value(flat, "localization_box")),
        "LERF mIoU": Cell.percent(measured.table_value(flat, "iou")),
        "3D-OVS mIoU": Cell.percent(measured.table_value(ovs, "iou")),
        **{name: cell for name, cell in levels.items() if name != "Avg"},
        "Hi-LERF mIoU": levels["Avg"],
        "Hi-LERF HC": Cell.percent(measured.table_value(part, "hc_containment")),
        "Avg, best threshold": measured.level_cells(part, "best_threshold_iou")["Avg"],
    }


def against_default(scores: "pd.DataFrame", part: "pd.DataFrame") -> Cell:
    """Return a row's mIoU over all seeds minus the default field's mIoU, paired by scene.

    Scenes differ more than rows do, so the spread of paired differences shows whether one row is better.
    """
    first = part.iloc[0]
    default = (scores["variant"] == "default") & (scores["method"] == "field")
    for key in ("dataset", "masks", "protocol"):
        default &= scores[key] == first[key]
    if (first["variant"], first["method"]) == ("default", "field"):
        return Cell()
    ours, others = (measured.level_averages_of_scenes(rows, "iou") for rows in (part, scores[default]))
    differences = 100 * (ours - others).dropna()
    if not len(differences):
        return Cell()
    mean = statistics.fmean(differences)
    if len(differences) == 1:
        return Cell(f"{mean:+.1f}", mean)
    error = statistics.stdev(differences) / math.sqrt(len(differences))
    return Cell(f"{mean:+.1f} ± {error:.1f}", mean, spread=error)
