"""Averages of scores (`scores.read_scores`), in the order that each protocol defines, and measured rows.

A (view, query) pair without a prediction has a row with value 0 unless its protocol omits such pairs.
"""

import statistics
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hilsplat.base.levels import LEVELS, Level
from hilsplat.configuration import seed_parts
from hilsplat.datasets.registry import DATASETS
from hilsplat.evaluate.protocols import cards
from hilsplat.evaluate.tables.kinds import TableKind
from hilsplat.evaluate.tables.rows import Block, Cell, Row, Sources
from hilsplat.segment.origin import made_from_truth

if TYPE_CHECKING:
    import pandas as pd

CellsOf = Callable[["pd.DataFrame", "pd.DataFrame"], dict[str, Cell]]

ANSWERS = {"field": "field", "tree": "tree", "tree-path": "tree, path", "truth": "annotations"}
"""Method -> its name in rows, in row order."""

PROTOCOLS = {
    cards.LEVEL_GIVEN.full_name: "level given",
    cards.SCENE_WIDE.full_name: "level given, scene-wide",
    cards.LEVEL_AUTO.full_name: "level chosen",
    cards.PATH.full_name: "path of texts",
    cards.ANNOTATIONS.full_name: "reference",
}
"""Protocol -> its name in tables; other protocols keep their own."""

SYNTHETIC_DATA = {
    "synthetic": "generated tabletops",
    "synthetic-rooms": "generated rooms",
    "synthetic-streets": "generated streets",
}
"""Synthetic data set -> its description in headings."""


def measured_blocks(
    kind: TableKind,
    sources: Sources,
    cells_of: CellsOf,
    over_seeds: CellsOf = lambda scores, part: {},
    label_of: Callable[[str], str] = lambda protocol: protocol,
) -> list[Block]:
    """Return one block per data set, with one row per variant, method, masks and protocol.

    Args:
        cells_of: computes a row's values from all scores and the row's scores of one seed.
        over_seeds: computes values from all seeds of the row.
        label_of: maps protocols to labels; those with the same label share a row.
    """
    scores = with_seeds(sources.scores)
    of_methods = scores[scores["method"].isin(kind.methods)] if kind.methods else scores
    blocks = []
    for protocols in kind.protocols:
        for data, of_data in of_methods.groupby("dataset", sort=True):
            selected = of_data[of_data["protocol"].str.startswith(protocols)]
            selected = selected.assign(label=selected["protocol"].map(label_of))
            rows: list[tuple[tuple[Any, ...], Row]] = []
            groups = selected.groupby(["variant", "masks", "method", "label"], sort=True)
            for (variant, masks, method, label), part in groups:
                part = of_comparable_seeds(part)
                seeds = [cells_of(scores, of_seed) for _, of_seed in part.groupby("seed", sort=True)]
                seeds = seeds[:1] if method == "truth" else seeds  # annotations are the same under every seed
                names = _row_names(variant, masks, method, label, sources.labels)
                if len(seeds) > 1:
                    names["Seeds"] = str(len(seeds))
                cells = mean_over_seeds(seeds) | over_seeds(scores, part)
                is_ranked = method != "truth" and not made_from_truth(masks)
                group = kind.ranked_with(label) if is_ranked else None
                order = row_place(variant, method, sources.labels)
                sort_key = made_from_truth(masks), _protocol_place(label), *order, masks, label
                scenes = part["scene"], selected["scene"], kind.averaged
                rows.append((sort_key, row_of(names, cells, str(data), *scenes, group)))
            if rows:
                distinct = without_repeats([row for _, row in sorted(rows, key=lambda pair: pair[0])])
                columns = kind.columns_of(selected["scene"])
                blocks.append(Block(*kind_and_title(str(data)), distinct, columns, kind.unranked))
    return blocks


def of_comparable_seeds(part: "pd.DataFrame") -> "pd.DataFrame":
    """Return a row's scores without seeds that lack scenes, whose means are of something else."""
    scenes = {seed: set(of_seed["scene"]) for seed, of_seed in part.groupby("seed", sort=True)}
    most = max(scenes.values(), key=len)
    return part[part["seed"].isin([seed for seed, count in scenes.items() if count == most])]


def _row_names(
    variant: str, masks: str, method: str, label: str, labels: Mapping[str, str]
) -> dict[str, str]:
    is_truth = method == "truth"
    warning = "diagnostic, true masks: " if made_from_truth(masks) and not is_truth else ""
    card, space, departures = label.partition(" ")
    return {
        "Method": warning + row_name(variant, method, labels),
        "Masks": "-" if is_truth else masks,
        "Protocol": PROTOCOLS.get(card, card) + space + departures,
    }


def _protocol_place(label: str) -> int:
    card, _, _ = label.partition(" ")  # before its departures
    return list(PROTOCOLS).index(card) if card in PROTOCOLS else -1


def row_of(
    names: Mapping[str, str],
    cells: Mapping[str, Cell],
    data: str,
    scenes: Collection[str],
    of_block: Collection[str],
    averaged: Collection[str] = (),
    group: str | None = "",
) -> Row:
    """Return a row; if its averages are over part of the scenes, it states so, and they are not ranked.

    All scenes are those that the data set lists and those of any row in the block.

    Args:
        averaged: the scenes of a listed data set that are averaged; empty for all.
    """
    listed = DATASETS[data].scenes if data in DATASETS else ()
    every = set(averaged) if listed and averaged else {*listed, *of_block}
    number = len(every & set(scenes))
    if number == len(every):
        return Row(names, cells, group)
    prefixes = tuple(f"{scene} " for scene in set(scenes))
    averages = tuple(column for column in cells if not column.startswith(prefixes))
    return Row({**names, "Scenes": f"{number} of {len(every)}"}, cells, group, averages)


def with_seeds(scores: "pd.DataFrame") -> "pd.DataFrame":
    """Move the seed into its own column (the first seed is 0); `seeded_variant` keeps the whole name."""
    parts = {name: seed_parts(name) for name in scores["variant"].unique()}
    variant, seed = (scores["variant"].map(lambda name, part=part: parts[name][part]) for part in (0, 1))
    return scores.assign(variant=variant, seed=seed, seeded_variant=scores["variant"])


def mean_over_seeds(seeds: Sequence[Mapping[str, Cell]]) -> dict[str, Cell]:
    """Return mean and standard deviation (n - 1) of the cells that every seed has; one seed is unchanged."""
    if len(seeds) == 1:
        return dict(seeds[0])
    cells = {}
    for column, first in seeds[0].items():
        if first.text.isdigit():  # counts do not depend on the seed
            cells[column] = first
            continue
        values = [value for of_seed in seeds if (value := of_seed.get(column, Cell()).value) is not None]
        if len(values) < len(seeds):  # a mean over some of the seeds is of something else
            continue
        mean, spread = statistics.fmean(values), statistics.stdev(values)
        cells[column] = Cell(f"{mean:.1f} ± {spread:.1f}", mean, first.note, spread)
    return cells


def without_repeats(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Remove duplicate rows: the annotations' row is the same for every variant."""
    seen: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        seen.setdefault((*row.names.values(), *(cell.text for cell in row.cells.values())), row)
    return tuple(seen.values())


def row_place(variant: str, method: str, labels: Mapping[str, str]) -> tuple[int, str, int]:
    """Return the sort key of a row: the default variant, then variants in label order, then others."""
    order, methods = ["default", *labels], list(ANSWERS)
    rank = order.index(variant) if variant in order else len(order)
    return rank, variant, methods.index(method) if method in methods else len(methods)


def row_name(variant: str, method: str, labels: Mapping[str, str]) -> str:
    """Return the name of a row: `hilsplat (field)` and `hilsplat (tree)` for the default variant.

    The label of any other variant refers to its field. Predictions from files have their program's name.
    """
    if method == "truth":
        return "annotations"
    label, answer = labels.get(variant, variant), ANSWERS.get(method, method)
    if variant == "default":
        return f"{labels.get('default', 'hilsplat')} ({answer})"
    return label if method in ("field", "files") else f"{label}, {answer}"


def kind_and_title(dataset: str) -> tuple[str, str, str]:
    """Return kind, data set and heading of measured rows."""
    if dataset.startswith("synthetic"):
        what = SYNTHETIC_DATA.get(dataset, dataset)
        return "synthetic stand-in", dataset, f"Measured on a synthetic stand-in ({what}); not comparable"
    return "measured", dataset, f"Measured on {dataset}"


def scene_cells(
    part: "pd.DataFrame", metrics: Mapping[str, str], average: str = "Average"
) -> dict[str, Cell]:
    """Return `<scene> <name>` for every scene, and the mean over scenes; `metrics` maps names to metrics."""
    cells = {}
    for name, metric in metrics.items():
        values = scene_values(part, metric)
        for scene in sorted(set(part["scene"])):
            cells[f"{scene} {name}"] = Cell.percent(values.get(scene, float("nan")))
        cells[f"{average} {name}"] = percent(part, metric)
    return cells


def level_cells(part: "pd.DataFrame", metric: str = "iou") -> dict[str, Cell]:
    """Return L1, L2, L3 and Avg, the mean of the levels that have rows."""
    present = level_values(part, metric)
    cells = {f"L{int(level)}": Cell.percent(present.get(level, float("nan"))) for level in LEVELS}
    cells["Avg"] = Cell.percent(sum(present.values()) / len(present) if present else float("nan"))
    return cells


def level_values(part: "pd.DataFrame", metric: str) -> dict[Level, float]:
    """Return the metric's value at each level that has rows (`table_value`)."""
    values = {level: table_value(part, metric, level.label) for level in LEVELS}
    return {level: value for level, value in values.items() if value == value}


def same_row(
    scores: "pd.DataFrame", part: "pd.DataFrame", protocols: tuple[str, ...], dataset: str | None = None
) -> "pd.DataFrame":
    """Return the scores (with seeds) of the same variant, seed, method and masks under other protocols.

    `protocols` are prefixes; `dataset` defaults to the row's own data set.
    """
    first = part.iloc[0]
    same = scores["protocol"].str.startswith(protocols) & (scores["dataset"] == (dataset or first["dataset"]))
    for key in ("variant", "seed", "masks", "method"):
        same &= scores[key] == first[key]
    return scores[same]


def scene_values(rows: "pd.DataFrame", metric: str, level: str | None = None) -> "pd.Series":
    """Return one number per scene, by name; scenes without a row are omitted.

    The number is the mean over the scene's rows (at `level`, if given). Under a protocol with averaging
    `classes`, it is the mean over the views of each query, then over queries.
    """
    values = rows[rows["metric"] == metric]
    if level is not None:
        values = values[values["level"] == level]
    orders = {cards.card_of(label).averaging for label in values["protocol"].unique()}
    assert len(orders) <= 1, f"rows of several averaging orders: {sorted(orders)}"
    assert "pooled" not in orders, "pooled protocols have no number per scene"
    if "classes" in orders:
        of_query = values.groupby(["scene", "query"], sort=True)["value"].mean()
        return of_query.groupby(level="scene", sort=True).mean()
    return values.groupby("scene", sort=True)["value"].mean()


def table_value(rows: "pd.DataFrame", metric: str, level: str | None = None) -> float:
    """Return the unweighted mean of the scenes' numbers; nan if there are no rows."""
    return float(scene_values(rows, metric, level).mean())


def percent(rows: "pd.DataFrame", metric: str) -> Cell:
    return Cell.percent(table_value(rows, metric))


def level_averages(rows: "pd.DataFrame", metric: str, pairs: list[str]) -> "pd.Series":
    """Return one number per scene, or per scene and seed, as `pairs` says: mean over levels, then seeds."""
    values = rows[rows["metric"] == metric]
    of_level = values.groupby(["scene", "seed", "level"], sort=True)["value"].mean()
    of_seed = of_level.groupby(level=["scene", "seed"], sort=True).mean()
    return of_seed.groupby(level=pairs, sort=True).mean()
