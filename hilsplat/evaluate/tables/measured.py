"""Rows from scores: one block per data set, one row per variant, method, masks and protocol."""

import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from hilsplat.evaluate.protocols.cards import ANNOTATIONS, LEVEL_AUTO, LEVEL_GIVEN, PATH, SCENE_WIDE
from hilsplat.evaluate.protocols.totals import level_values, mean_over_levels, scene_values, table_value
from hilsplat.evaluate.tables.rows import Block, Cell, Row
from hilsplat.evaluate.tables.sources import Sources
from hilsplat.segment.origin import made_from_truth

if TYPE_CHECKING:
    import pandas as pd

SYNTHETIC = "synthetic"
"""Prefix of the names of synthetic data sets."""

SEED = re.compile(r"(?P<variant>.+)\.seed(?P<seed>[0-9]+)")
"""A variant's name with a seed; all seeds of a variant share a row."""

ANSWERS = {"field": "field", "tree": "tree", "tree-path": "tree, path", "truth": "annotations"}
"""Method -> its name in rows, in row order."""

PROTOCOLS = {
    LEVEL_GIVEN.full_name: "level given",
    SCENE_WIDE.full_name: "level given, scene-wide",
    LEVEL_AUTO.full_name: "level chosen",
    PATH.full_name: "path of texts",
    ANNOTATIONS.full_name: "reference",
}
"""Protocol -> its name in tables; other protocols keep their own."""

STAND_INS = {
    "synthetic": "tables of the synthetic world",
    "synthetic-rooms": "rooms of the synthetic world",
    "synthetic-streets": "streets of the synthetic world",
}
"""Synthetic data set -> its description in headings."""

TRUE_MASKS = "diagnostic, true masks: "
"""Prefix of the method's name in rows whose masks were made from true labels."""


def measured_blocks(
    sources: Sources,
    protocols: tuple[str, ...],
    cells_of: Callable[["pd.DataFrame"], dict[str, Cell]],
    columns_of: Callable[["pd.DataFrame"], Sequence[str]],
    unranked: frozenset[str] = frozenset(),
    ranked_by_protocol: bool = True,
    over_seeds: Callable[["pd.DataFrame"], dict[str, Cell]] = lambda part: {},
    label_of: Callable[[str], str] = lambda protocol: protocol,
) -> list[Block]:
    """Return one block per data set, with one row per variant, method, masks and protocol.

    Args:
        protocols: prefixes of the protocols that have rows.
        cells_of: computes a row's values from the scores of one variant, method, masks, protocol and seed.
        columns_of: returns the value columns, from the scores of a data set.
        ranked_by_protocol: whether rows of different protocols are ranked separately.
        over_seeds: computes further values of a row from the scores of all its seeds.
        label_of: maps protocols to labels; those with the same label share a row.
    """
    if sources.scores.empty:
        return []
    blocks = []
    for data, of_data in with_seeds(sources.scores).groupby("dataset", sort=True):
        rows = []
        selected = of_data[of_data["protocol"].str.startswith(protocols)]
        selected = selected.assign(label=selected["protocol"].map(label_of))
        for (*_, label), part in selected.groupby(["variant", "masks", "method", "label"], sort=True):
            group = label if ranked_by_protocol else ""
            place, row = placed_row(label, part, sources.labels, cells_of, group)
            rows.append((place, replace(row, cells={**row.cells, **over_seeds(part)})))
        ordered = [row for _, row in sorted(rows, key=lambda placed: placed[0])]
        distinct = without_repeats(ordered)
        if distinct:
            columns = tuple(columns_of(selected))
            blocks.append(Block(*kind_and_title(str(data)), distinct, columns, unranked=unranked))
    return blocks


def placed_row(
    label: str,
    part: "pd.DataFrame",
    labels: Mapping[str, str],
    cells_of: Callable[["pd.DataFrame"], Mapping[str, Cell]],
    group: str,
) -> tuple[tuple, Row]:
    """Return one row and its position among the rows of a block.

    Args:
        label: full name of the protocol, or another label that distinguishes the row.
        part: scores of the row under all its seeds.
        cells_of: computes the row's values from the scores of one seed.
        group: rows of a group are ranked together; annotations and true masks are not ranked.
    """
    variant, masks, method = part.iloc[0][["variant", "masks", "method"]]
    is_diagnostic = method != "truth" and made_from_truth(masks)
    title = row_name(variant, method, labels)
    names = {
        "Method": TRUE_MASKS + title if is_diagnostic else title,
        "Masks": masks if method != "truth" else "-",
        "Protocol": PROTOCOLS.get(label, label),
    }
    seeds = [cells_of(of_seed) for _, of_seed in part.groupby("seed", sort=True)]
    if method == "truth":
        seeds = seeds[:1]  # annotations are the same under every seed
    if len(seeds) > 1:
        names["Seeds"] = str(len(seeds))
    order = ["default", *labels]
    place = (
        made_from_truth(masks),
        list(PROTOCOLS).index(label) if label in PROTOCOLS else -1,
        order.index(variant) if variant in order else len(order),
        variant,
        list(ANSWERS).index(method) if method in ANSWERS else len(ANSWERS),
        masks,
        label,
    )
    ranked_with = None if method == "truth" or is_diagnostic else group
    return place, Row(names, mean_over_seeds(seeds), ranked_with)


def with_seeds(scores: "pd.DataFrame") -> "pd.DataFrame":
    """Move the seed into its own column; the first seed is "0"."""
    parts = scores["variant"].str.extract(f"^{SEED.pattern}$")
    variant = parts["variant"].fillna(scores["variant"])
    return scores.assign(variant=variant, seed=parts["seed"].fillna("0"))


def mean_over_seeds(seeds: Sequence[Mapping[str, Cell]]) -> dict[str, Cell]:
    """Return mean and standard deviation (n - 1) of each cell over seeds; one seed is unchanged."""
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
    """Remove duplicate rows: the annotations' row is the same for every variant."""
    seen: dict[tuple, Row] = {}
    for row in rows:
        key = (*row.names.values(), *(cell.text for cell in row.cells.values()))
        seen.setdefault(key, row)
    return tuple(seen.values())


def row_name(variant: str, method: str, labels: Mapping[str, str]) -> str:
    """Return the name of a row, from its variant and method.

    The default variant has rows for field and tree, `hilsplat (field)` and `hilsplat (tree)`; the label of
    any other variant refers to its field. Predictions from files are named after their program.
    """
    if method == "truth":
        return "annotations"
    label, answer = labels.get(variant, variant), ANSWERS.get(method, method)
    if variant == "default":
        return f"{labels.get('default', 'hilsplat')} ({answer})"
    return label if method in ("field", "files") else f"{label}, {answer}"


def kind_and_title(dataset: str) -> tuple[str, str, str]:
    """Return kind, data set and heading of measured rows."""
    if dataset.startswith(SYNTHETIC):
        what = STAND_INS.get(dataset, dataset)
        return "synthetic stand-in", dataset, f"Measured on a synthetic stand-in ({what}); not comparable"
    return "measured", dataset, f"Measured on {dataset}"


def scene_cells(
    part: "pd.DataFrame", metrics: Mapping[str, str], average: str = "Average"
) -> dict[str, Cell]:
    """Return the columns `<scene> <name>` of every scene, and their mean as `<average> <name>`.

    Args:
        metrics: name in the column -> metric.
    """
    cells = {}
    for name, metric in metrics.items():
        values = scene_values(part, metric)
        for scene in sorted(set(part["scene"])):
            cells[f"{scene} {name}"] = Cell.percent(values.get(scene, float("nan")))
        cells[f"{average} {name}"] = Cell.percent(table_value(part, metric))
    return cells


def level_cells(part: "pd.DataFrame", metric: str = "iou") -> dict[str, Cell]:
    """Return L1, L2, L3 and Avg, the mean of the levels that have rows."""
    values = level_values(part, metric)
    cells = {f"L{int(level)}": Cell.percent(value) for level, value in values.items()}
    return {**cells, "Avg": Cell.percent(mean_over_levels(values.values()))}


def same_row(
    scores: "pd.DataFrame", part: "pd.DataFrame", protocols: tuple[str, ...], dataset: str | None = None
) -> "pd.DataFrame":
    """Return the scores of the same variant, seed, method and masks under other protocols.

    Args:
        scores: scores with seeds (`with_seeds`).
        protocols: prefixes of the protocols' names.
        dataset: data set of the scores; None for the row's own.
    """
    first = part.iloc[0]
    same = scores["protocol"].str.startswith(protocols) & (scores["dataset"] == (dataset or first["dataset"]))
    for key in ("variant", "seed", "masks", "method"):
        same &= scores[key] == first[key]
    return scores[same]
