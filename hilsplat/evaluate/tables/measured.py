"""Rows from scores: one block per data set, one row per variant, method, masks and protocol."""

import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from hilsplat.evaluate.protocols.cards import ANNOTATIONS, LEVEL_AUTO, LEVEL_GIVEN, PATH, SCENE_WIDE
from hilsplat.evaluate.protocols.totals import level_values, mean_over_levels, scene_values, table_value
from hilsplat.evaluate.tables.rows import Block, Cell, Row
from hilsplat.segment.origin import made_from_truth

if TYPE_CHECKING:
    import pandas as pd

SYNTHETIC = "synthetic"
"""Data sets whose names begin with this are stand-ins."""

SEED = re.compile(r"(?P<variant>.+)\.seed(?P<seed>[0-9]+)")
"""A variant's name with a seed; all seeds of a variant share one row."""

ANSWERS = {"field": "field", "tree": "tree", "tree-path": "tree, path", "truth": "annotations"}
"""Method -> its name in rows, in the order of rows."""

PROTOCOLS = {
    LEVEL_GIVEN.full_name: "level given",
    SCENE_WIDE.full_name: "level given, scene-wide",
    LEVEL_AUTO.full_name: "level chosen",
    PATH.full_name: "path of texts",
    ANNOTATIONS.full_name: "reference",
}
"""Protocol -> its name in tables; others keep their own."""

STAND_INS = {
    "synthetic": "tables of the synthetic world",
    "synthetic-rooms": "rooms of the synthetic world",
    "synthetic-streets": "streets of the synthetic world",
}
"""Data set of a stand-in -> its description in headings."""

TRUE_MASKS = "diagnostic, true masks: "
"""Prefix of the method's name in rows whose masks were made from true labels."""


def measured_blocks(
    scores: "pd.DataFrame",
    labels: Mapping[str, str],
    protocols: tuple[str, ...],
    cells_of: Callable[["pd.DataFrame"], dict[str, Cell]],
    columns_of: Callable[["pd.DataFrame"], Sequence[str]],
    unranked: frozenset[str] = frozenset(),
    ranked_by_protocol: bool = True,
    lower_is_better: frozenset[str] = frozenset(),
    over_seeds: Callable[["pd.DataFrame"], dict[str, Cell]] = lambda part: {},
) -> list[Block]:
    """One block per data set; one row per variant, method, masks and protocol.

    Args:
        scores: rows of `scores.csv`.
        labels: variant -> its name in the table.
        protocols: prefixes of the protocols that make a row.
        cells_of: values of a row, from the scores of one variant, method, masks, protocol and seed.
        columns_of: value columns, from the scores of a data set.
        unranked: columns in which nothing is best.
        ranked_by_protocol: rows of different protocols are not ranked against each other.
        lower_is_better: columns in which the smallest value is best.
        over_seeds: further values of a row, from the scores of all its seeds together.
    """
    if scores.empty:
        return []
    blocks = []
    scores = with_seeds(scores)
    for data, of_data in scores.groupby("dataset", sort=True):
        rows = []
        wanted = of_data[of_data["protocol"].str.startswith(protocols)]
        keys = ["variant", "masks", "method", "protocol"]
        for (variant, masks, method, protocol), part in wanted.groupby(keys, sort=True):
            group = protocol if ranked_by_protocol else ""
            place, row = placed_row(variant, masks, method, protocol, part, labels, cells_of, group)
            rows.append((place, replace(row, cells={**row.cells, **over_seeds(part)})))
        distinct = without_repeats(in_order(rows))
        if distinct:
            columns = tuple(columns_of(wanted))
            blocks.append(
                Block(*kind_and_title(str(data)), distinct, columns, lower_is_better, unranked=unranked)
            )
    return blocks


def placed_row(
    variant: str,
    masks: str,
    method: str,
    protocol: str,
    part: "pd.DataFrame",
    labels: Mapping[str, str],
    cells_of: Callable[["pd.DataFrame"], Mapping[str, Cell]],
    group: str,
) -> tuple[tuple, Row]:
    """One row, and its place among the rows of a block (`in_order`).

    Args:
        variant: named set of settings.
        masks: what made the masks.
        method: what answered.
        protocol: full name of the protocol, or what else tells the row from its neighbours.
        part: the scores of the row under all its seeds.
        labels: variant -> its name in the table.
        cells_of: values of the row, from the scores of one seed.
        group: rows of a group are ranked together; annotations and true masks are not ranked.
    """
    is_diagnostic = method != "truth" and made_from_truth(masks)
    title = row_name(variant, method, labels)
    names = {
        "Method": TRUE_MASKS + title if is_diagnostic else title,
        "Masks": masks if method != "truth" else "-",
        "Protocol": PROTOCOLS.get(protocol, protocol),
    }
    seeds = [cells_of(of_seed) for _, of_seed in part.groupby("seed", sort=True)]
    if method == "truth":
        seeds = seeds[:1]  # annotations are the same under every seed
    if len(seeds) > 1:
        names["Seeds"] = str(len(seeds))
    order = ["default", *labels]
    place = (
        made_from_truth(masks),
        list(PROTOCOLS).index(protocol) if protocol in PROTOCOLS else -1,
        order.index(variant) if variant in order else len(order),
        variant,
        list(ANSWERS).index(method) if method in ANSWERS else len(ANSWERS),
        masks,
        protocol,
    )
    ranked_with = None if method == "truth" or is_diagnostic else group
    return place, Row(names, mean_over_seeds(seeds), ranked_with)


def in_order(rows: Sequence[tuple[tuple, Row]]) -> list[Row]:
    """Rows sorted by their places."""
    return [row for _, row in sorted(rows, key=lambda placed: placed[0])]


def with_seeds(scores: "pd.DataFrame") -> "pd.DataFrame":
    """Move the seed into its own column; the first seed is "0"."""
    parts = scores["variant"].str.extract(f"^{SEED.pattern}$")
    variant = parts["variant"].fillna(scores["variant"])
    return scores.assign(variant=variant, seed=parts["seed"].fillna("0"))


def mean_over_seeds(seeds: Sequence[Mapping[str, Cell]]) -> dict[str, Cell]:
    """Mean of each cell and its standard deviation (n - 1) over seeds; one seed stays unchanged."""
    if len(seeds) == 1:
        return dict(seeds[0])
    cells = {}
    for column, first in seeds[0].items():
        values = [value for cells in seeds if (value := cells.get(column, Cell()).value) is not None]
        if len(values) < 2 or first.text.isdigit():  # counts do not depend on the seed
            cells[column] = first
            continue
        mean, spread = statistics.fmean(values), statistics.stdev(values)
        cells[column] = Cell(f"{mean:.1f} ± {spread:.1f}", mean, first.note, spread)
    return cells


def without_repeats(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Keep one of each set of equal rows: the annotations' row is the same for every variant."""
    seen: dict[tuple, Row] = {}
    for row in rows:
        key = (*row.names.values(), *(cell.text for cell in row.cells.values()))
        seen.setdefault(key, row)
    return tuple(seen.values())


def row_name(variant: str, method: str, labels: Mapping[str, str]) -> str:
    """Name of a row, from its variant and method.

    The default variant answers by field and tree, `hilsplat (field)` and `hilsplat (tree)`; another
    variant's label is that of its field. Predictions from files bear the name of their program.
    """
    if method == "truth":
        return "annotations"
    label, answer = labels.get(variant, variant), ANSWERS.get(method, method)
    if variant == "default":
        return f"{labels.get('default', 'hilsplat')} ({answer})"
    return label if method in ("field", "files") else f"{label}, {answer}"


def kind_and_title(dataset: str) -> tuple[str, str, str]:
    """Kind, data set and heading of measured rows."""
    if dataset.startswith(SYNTHETIC):
        what = STAND_INS.get(dataset, dataset)
        return "synthetic stand-in", dataset, f"Measured on a synthetic stand-in ({what}); not comparable"
    return "measured", dataset, f"Measured on {dataset}"


def scene_cells(
    part: "pd.DataFrame", metrics: Mapping[str, str], average: str = "Average"
) -> dict[str, Cell]:
    """Columns `<scene> <name>` of every scene, and the mean over scenes.

    Args:
        part: the scores of one row.
        metrics: name in the column -> metric.
        average: prefix of the mean's column.
    """
    cells = {}
    for name, metric in metrics.items():
        values = scene_values(part, metric)
        for scene in sorted(set(part["scene"])):
            cells[f"{scene} {name}"] = Cell.percent(values.get(scene, float("nan")))
        cells[f"{average} {name}"] = Cell.percent(table_value(part, metric))
    return cells


def level_cells(part: "pd.DataFrame", metric: str = "iou") -> dict[str, Cell]:
    """L1, L2, L3 and Avg, the mean of the levels that have rows."""
    values = level_values(part, metric)
    cells = {f"L{int(level)}": Cell.percent(value) for level, value in values.items()}
    return {**cells, "Avg": Cell.percent(mean_over_levels(values.values()))}


def same_row(
    scores: "pd.DataFrame", part: "pd.DataFrame", protocols: tuple[str, ...], dataset: str | None = None
) -> "pd.DataFrame":
    """Return what the same variant, seed, method and masks scored under other protocols.

    Args:
        scores: scores with seeds (`with_seeds`).
        part: the scores of one row.
        protocols: prefixes of the protocols' names.
        dataset: data set of the scores; None: that of the row.
    """
    first = part.iloc[0]
    keys = ("variant", "seed", "masks", "method")
    same = scores["protocol"].str.startswith(protocols) & (scores["dataset"] == (dataset or first["dataset"]))
    for key in keys:
        same &= scores[key] == first[key]
    return scores[same]
