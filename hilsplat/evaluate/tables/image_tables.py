"""Measured rows of labelled images: LERF, 3D-OVS, queries at three levels, ablations, scored frames."""

import math
import statistics
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from hilsplat.base.tables import counted
from hilsplat.datasets.registry import DATASETS
from hilsplat.datasets.sources import LEVELLED
from hilsplat.evaluate.metrics.hierarchy import READINGS
from hilsplat.evaluate.protocols.cards import LEVEL_GIVEN, VIEW_CONSISTENCY
from hilsplat.evaluate.tables import measured
from hilsplat.evaluate.tables.kinds import TABLES, TableKind
from hilsplat.evaluate.tables.rows import Block, Cell, Row, Sources

if TYPE_CHECKING:
    import pandas as pd


def lerf_cells(_: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    return measured.scene_cells(
        part, {"mIoU": "iou", "mBIoU": "boundary_iou", "localization": "localization_box"}
    )


def ovs_cells(_: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return mIoU per scene, and mIoU and accuracy over the scenes of the paper."""
    cells = measured.scene_cells(part, {"mIoU": "iou"})
    if averaged := averaged_scenes(part.iloc[0]["dataset"]):
        part = part[part["scene"].isin(averaged)]
    overall = {"Overall mIoU": "iou", "Overall accuracy": "pixel_accuracy"}
    return cells | {name: measured.percent(part, metric) for name, metric in overall.items()}


def averaged_scenes(data: str) -> set[str]:
    """Return the scenes of a data set that averages without levels cover; empty for all that are scored."""
    listed = DATASETS[data].scenes if data in DATASETS else ()
    return {*(TABLES["3dovs"].averaged if data == "3d_ovs" else listed)}


def hierarchy_cells(scores: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return mIoU at three levels, hierarchical consistency and view consistency."""
    ious = part[part["metric"] == "iou"]
    above = ious.assign(value=(ious["value"] > 0.25).astype(float))
    cells = {
        **measured.level_cells(part),
        "Acc@0.25": measured.percent(above, "iou"),
        **{f"HC {reading}": measured.percent(part, f"hc_{reading}") for reading in READINGS},
        "Avg, best threshold": measured.level_cells(part, "best_threshold_iou")["Avg"],
        "Pairs": Cell.count(len(ious)) if len(ious) else Cell(),
    }
    if part["protocol"].iloc[0].startswith(LEVEL_GIVEN.full_name):
        consistency = measured.same_row(scores, part, (VIEW_CONSISTENCY.full_name,))
        cells["View consistency"] = measured.level_cells(consistency, "view_consistency")["Avg"]
    return cells


def ablation_blocks(kind: TableKind, sources: Sources) -> list[Block]:
    """Return a row per variant and method, the ablation's protocols side by side."""
    over_seeds = partial(step_cells, kind.steps, sources.labels)
    blocks = measured.measured_blocks(kind, sources, component_cells, over_seeds)
    return [replace(block, columns=tuple(block.filled_columns())) for block in blocks]


def component_cells(scores: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return the values of one row under all protocols; `flat_scores` selects those without levels."""
    flat = flat_scores(scores, part, ("lerf/langsplat@", "lerf/tree-nodes@"), "lerf_ovs")
    ovs = flat_scores(scores, part, ("3d-ovs/langsplat@",), "3d_ovs")
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


def flat_scores(
    scores: "pd.DataFrame", part: "pd.DataFrame", protocols: tuple[str, ...], benchmark: str
) -> "pd.DataFrame":
    """Return a row's scores without levels, or none if a scene that they should cover has none.

    Hi-LERF and Hi-3DOVS label images of LERF and 3D-OVS; their rows show scores on the labels of `benchmark`.
    These cover its averaged scenes; if they are of the row's images, only those that the row covers. Rows
    of other data show scores on their own labels.
    """
    own, covered = part.iloc[0]["dataset"], set(part["scene"])
    data = benchmark if own in LEVELLED else own
    if data != own:
        averaged = averaged_scenes(data)
        covered = averaged & covered if DATASETS[own].images_of == data else averaged
    flat = measured.same_row(scores, part, protocols, data)
    flat = flat[flat["scene"].isin(covered)]
    return flat if set(flat["scene"]) == covered else flat[:0]


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
        blocks.append(Block(*measured.kind_and_title(dataset), tuple(rows), tuple(sorted(of_scenes))))
    return blocks
