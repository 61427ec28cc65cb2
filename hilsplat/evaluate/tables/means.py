"""Means of score files by method and protocol, for people: what a run and `evaluate-files` print."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hilsplat.base.artifacts import write_text
from hilsplat.base.levels import LEVELS
from hilsplat.base.tables import markdown_table, plain_markdown, write_csv
from hilsplat.evaluate.protocols.cards import INSTANCES, ProtocolCard, card_of
from hilsplat.evaluate.scores import read_scores
from hilsplat.evaluate.tables.measured import level_values, row_name, row_place, table_value
from hilsplat.evaluate.tables.rows import Cell

if TYPE_CHECKING:
    import pandas as pd

IOUS = ("iou", "miou_absent_as_one", "miou_occurring", "miou_all", "miou_present", "frequency_weighted_iou")
METRICS = {
    "mIoU": IOUS,
    "localized": ("localization_mask",),
    "accuracy": ("pixel_accuracy", "macc_present", "macc_all"),
    "AP": ("ap",),
}
"""Column -> metrics; the first that a protocol has is shown."""

COLUMNS = (
    *("method", "labels", "mIoU", *(level.label for level in LEVELS), "localized", "accuracy", "AP"),
    *("queries", "protocol"),
)
"""Columns of a table of means; empty ones are omitted. All values but the number of queries are in %.

`labels` is the data set of the labels, if a scene has those of several.
"""

TEXTS = ("method", "labels", "protocol")  # columns that are not numbers


def mean_rows(scores: "pd.DataFrame", labels: Mapping[str, str]) -> list[list[str]]:
    """Return a header and one row per method, data set and protocol, averaged as the protocol's card says.

    Protocols without an IoU or a precision, such as view consistency, have no row.

    Args:
        scores: rows of one scene (`read_scores`).
        labels: variant -> its name; a variant without one keeps its own.
    """
    entries, of_several = [], scores["dataset"].nunique() > 1
    keys = ["variant", "method", "dataset", "protocol"]
    for (variant, method, dataset, protocol), part in scores.groupby(keys, sort=True):
        means = _means(protocol, part)
        if means["mIoU"].value is None and means["AP"].value is None:
            continue
        queries = int(part["metric"].isin(("iou", "class_iou")).sum())
        row = {column: "" if cell.value is None else cell.text for column, cell in means.items()}
        row |= {"method": row_name(variant, method, labels), "protocol": protocol}
        row |= {"queries": str(queries or ""), "labels": dataset if of_several else ""}
        entries.append((row_place(variant, method, labels), dataset, protocol, row))
    rows = [row for *_, row in sorted(entries, key=lambda entry: entry[:3])]
    columns = [column for column in COLUMNS if any(row.get(column) for row in rows)]
    return [columns, *([row.get(column, "") for column in columns] for row in rows)] if rows else []


def _means(protocol: str, part: "pd.DataFrame") -> dict[str, Cell]:
    """Return the mean of each column's metric under one protocol, and mIoU at each level that has rows."""
    card = card_of(protocol)
    means = metric_means(card, part)

    def cell(metrics: Sequence[str]) -> Cell:
        return Cell.percent(means.get(next((name for name in metrics if name in card.metrics), ""), math.nan))

    cells = {column: cell(metrics) for column, metrics in METRICS.items()}
    if card.averaging == "levels":
        cells |= {lv.label: Cell.percent(means.get(f"iou/{lv.label}", math.nan)) for lv in LEVELS}
    return cells


def metric_means(card: ProtocolCard, part: "pd.DataFrame") -> dict[str, float]:
    """Return each metric's mean over the rows of one method, in the order that the protocol's card states.

    Under a protocol with levels, the mean at each level that has rows is added, as `iou/whole`.
    """
    if card is INSTANCES:
        return dict(zip(part["metric"], part["value"], strict=True))
    if card.averaging == "pooled":
        from hilsplat.evaluate.protocols.points import class_set, pooled_points

        return pooled_points(card, part.itertuples(), class_set(card.classes)[1])
    means: dict[str, float] = {}
    measured = part["metric"].unique()
    for metric in (name for name in card.metrics if name in measured and not name.startswith("class_")):
        if part.loc[part["metric"] == metric, "level"].any():
            of_levels = level_values(part, metric)
            means[metric] = sum(of_levels.values()) / len(of_levels)
            means |= {f"{metric}/{level.label}": value for level, value in of_levels.items()}
        else:
            means[metric] = table_value(part, metric)
    return means


def run_score_means(paths: Sequence[Path], labels: Mapping[str, str], out: Path) -> None:
    """Write the means of a scene's score files as Markdown, and beside it as CSV (`mean_rows`).

    Raises:
        ArtifactError: a score file is missing or damaged.
    """
    columns, *rows = mean_rows(read_scores(paths), labels) or [[*COLUMNS]]
    lines = [[plain_markdown(cell) for cell in row] for row in rows]
    write_text(out, markdown_table(columns, lines, 1) + "\n")
    write_csv(out.with_suffix(".csv"), columns, rows)
