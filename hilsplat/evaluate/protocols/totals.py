"""Average rows of scores to a number in a table, in the averaging order of their protocol.

Rows are a frame of `scores.csv` (`evaluate.scores.read_scores`). A pair without a prediction has a row with
value 0 unless its protocol omits such pairs.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from hilsplat.base.levels import LEVELS, Level
from hilsplat.evaluate.protocols.cards import card_of

if TYPE_CHECKING:
    import pandas as pd


def scene_values(rows: "pd.DataFrame", metric: str, level: str | None = None) -> "pd.Series":
    """Return one number per scene, by name; scenes without a row are omitted.

    The number is the mean over the scene's rows; under a protocol with averaging `classes`, the mean over
    the views of each query, then over queries.

    Args:
        rows: rows of one table row, which share an averaging order.
        level: rows of other levels are ignored; None keeps all.
    """
    kept = rows[rows["metric"] == metric]
    if level is not None:
        kept = kept[kept["level"] == level]
    orders = {card_of(label).averaging for label in kept["protocol"].unique()}
    assert len(orders) <= 1, f"rows of several averaging orders: {sorted(orders)}"
    assert "pooled" not in orders, "pooled protocols have no number per scene"
    if "classes" in orders:
        of_query = kept.groupby(["scene", "query"], sort=True)["value"].mean()
        return of_query.groupby(level="scene", sort=True).mean()
    return kept.groupby("scene", sort=True)["value"].mean()


def table_value(rows: "pd.DataFrame", metric: str, level: str | None = None) -> float:
    """Return the unweighted mean of the scenes' numbers; nan without a row."""
    return float(scene_values(rows, metric, level).mean())


def share_above(rows: "pd.DataFrame", metric: str, threshold: float) -> float:
    """Return the share of rows above a threshold, such as Acc@0.25, averaged as the values themselves are."""
    return table_value(rows.assign(value=(rows["value"] > threshold).astype(float)), metric)


def level_values(rows: "pd.DataFrame", metric: str) -> dict[Level, float]:
    """Return the number of each level, L1 to L3; nan for a level without a row."""
    return {level: table_value(rows, metric, level.label) for level in LEVELS}


def mean_over_levels(values: Iterable[float]) -> float:
    """Return the mean of the levels that have a number (column Avg); nan if none has."""
    present = [value for value in values if value == value]
    return sum(present) / len(present) if present else float("nan")


def level_averages_of_scenes(rows: "pd.DataFrame", metric: str) -> "pd.Series":
    """Return one number per scene: mean over the rows of a level, then over levels, then over seeds.

    Used to pair two table rows by scene.

    Args:
        rows: rows with a seed column (`tables.measured.with_seeds`).
    """
    kept = rows[rows["metric"] == metric]
    of_level = kept.groupby(["scene", "seed", "level"], sort=True)["value"].mean()
    of_seed = of_level.groupby(level=["scene", "seed"], sort=True).mean()
    return of_seed.groupby(level="scene", sort=True).mean()
