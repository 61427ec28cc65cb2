"""Means of score files by method and protocol, for people: what a run and `evaluate-files` print."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hilsplat.base.artifacts import write_text
from hilsplat.base.levels import LEVELS
from hilsplat.base.tables import markdown_table, plain_markdown, write_csv
from hilsplat.evaluate.protocols.cards import INSTANCES, card_of
from hilsplat.evaluate.scores import read_scores
from hilsplat.evaluate.tables.measured import level_cells, percent, row_name, row_place
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
    *("method", "mIoU", *(level.label for level in LEVELS), "localized", "accuracy", "AP"),
    *("queries", "protocol"),
)
"""Columns of a table of means; empty ones are omitted. All values but the number of queries are in %."""

TEXTS = ("method", "protocol")  # columns that are not numbers


def mean_rows(scores: "pd.DataFrame", labels: Mapping[str, str]) -> list[list[str]]:
    """Return a header and one row per method and protocol, averaged as the protocol's card says.

    Protocols without an IoU or a precision, such as view consistency, have no row.

    Args:
        scores: rows of one scene (`read_scores`).
        labels: variant -> its name; a variant without one keeps its own.
    """
    found = []
    for (variant, method, protocol), part in scores.groupby(["variant", "method", "protocol"], sort=True):
        means = _means(protocol, part)
        if means["mIoU"].value is None and means["AP"].value is None:
            continue
        queries = int(part["metric"].isin(("iou", "class_iou")).sum())
        row = {column: "" if cell.value is None else cell.text for column, cell in means.items()}
        row |= {"method": row_name(variant, method, labels), "protocol": protocol}
        row["queries"] = str(queries or "")
        found.append((row_place(variant, method, labels), protocol, row))
    rows = [row for *_, row in sorted(found, key=lambda each: each[:2])]
    columns = [column for column in COLUMNS if any(row.get(column) for row in rows)]
    return [columns, *([row.get(column, "") for column in columns] for row in rows)] if rows else []


def _means(protocol: str, part: "pd.DataFrame") -> dict[str, Cell]:
    """Return the mean of each column's metric under one protocol, and mIoU at each level that has rows."""
    card, pooled = card_of(protocol), dict[str, float]()
    if card is INSTANCES:
        pooled = dict(zip(part["metric"], part["value"], strict=True))
    elif card.averaging == "pooled":
        from hilsplat.evaluate.protocols.points import class_set, pooled_points

        pooled = pooled_points(card, part.itertuples(), class_set(card.classes)[1])

    def mean_of(metrics: Sequence[str]) -> Cell:
        metric = next((metric for metric in metrics if metric in card.metrics), "")
        if card.averaging == "pooled":
            return Cell.percent(pooled.get(metric, math.nan))
        return level_cells(part, metric)["Avg"] if card.averaging == "levels" else percent(part, metric)

    means = {column: mean_of(metrics) for column, metrics in METRICS.items()}
    if card.averaging == "levels":
        of_level = level_cells(part)
        means |= {level.label: of_level[f"L{int(level)}"] for level in LEVELS}
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
