"""Time and memory: computational cost, efficiency, pruning.

Time and memory of jobs differ from run to run. They are in separate tables, whose names end with `-seconds`,
so that the other tables are reproducible byte for byte.
"""

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import replace

from hilsplat.datasets.sources import LEVELLED
from hilsplat.evaluate.protocols.cards import LEVEL_GIVEN
from hilsplat.evaluate.tables.ablation import PAPER_DATA, component_cells
from hilsplat.evaluate.tables.costs import Cost
from hilsplat.evaluate.tables.measured import ANSWERS, kind_and_title, row_name, with_seeds
from hilsplat.evaluate.tables.rows import Block, Cell, Row, Sources, Table

SECONDS = "-seconds"
"""Suffix of the names of tables that are not reproducible byte for byte."""

COST_NOTE = (
    "Measured rows, on this machine, means over scenes: preparation is masks, trees of the views and CLIP; "
    "training is contributions, semantic tree, autoencoder and field; neither includes the 3D Gaussians. "
    "Memory is the peak of the training jobs, in main memory (the paper: GPU). A query is one text in one "
    "view: text encoding, compositing weights of the view, relevancy and mask."
)


def cost_table(sources: Sources, seconds: bool = False) -> Table:
    """Build the table of training time, memory and seconds per query (paper: computational costs)."""
    blocks = [reported(sources, "one RTX 3090")]
    for data, costs in by_dataset(sources.costs).items():
        columns = ["Preparation (min)", "Training (min)", "Memory (GB)"]
        columns += [f"{scene} query (s)" for scene in sorted({cost.scene for cost in costs})]
        rows = []
        for variant, method, of_row in by_answer(sources, costs):
            queries = {f"{cost.scene} query (s)": Cell.number(cost.query_s[method]) for cost in of_row}
            names = {"Method": row_name(variant, method, sources.labels)}
            rows.append(Row(names, {**time_cells(of_row), **queries}))
        blocks.append(Block(*kind_and_title(data), tuple(rows), tuple(columns), costs_of(columns)))
    return finished(sources, "cost", "Computational cost", blocks, seconds)


def efficiency_table(sources: Sources, seconds: bool = False) -> Table:
    """Build the table of quality at three levels beside training time and memory (paper: efficiency)."""
    columns = ("Preparation (min)", "Training (min)", "Memory (GB)")
    blocks = [reported(sources, "one RTX 3090"), *quality_blocks(sources, columns)]
    return finished(sources, "efficiency", "Efficiency", blocks, seconds)


def pruning_table(sources: Sources, seconds: bool = False) -> Table:
    """Build the table of cost and quality with pruned contrastive pairs (paper: sample pruning)."""
    columns = ("Training (min)", "Memory (GB)", "Query (s)")
    blocks = [reported(sources, "sample pruning"), *quality_blocks(sources, columns, ("field",))]
    footnote = (
        "The paper removes redundant pairs by similarity of features and gives no rule. What our variant "
        "removes is set in config/config.yaml (variants)."
    )
    return finished(sources, "pruning", "Cost with pruned pairs", blocks, seconds, (footnote,))


def finished(
    sources: Sources,
    name: str,
    title: str,
    blocks: Sequence[Block],
    seconds: bool,
    footnotes: Sequence[str] = (),
) -> Table:
    """Return a table with all columns, or only with those that are reproducible."""
    if seconds:
        return sources.finished(name + SECONDS, f"{title}, on this machine", blocks, (COST_NOTE, *footnotes))
    repeated = []
    for block in blocks:
        if block.kind != "reported":
            columns = tuple(column for column in block.columns if column not in block.lower_is_better)
            own = [{name: cell for name, cell in row.cells.items() if name in columns} for row in block.rows]
            rows = [replace(row, cells=cells) for row, cells in zip(block.rows, own, strict=True)]
            block = replace(block, rows=tuple(rows), columns=columns)
        if block.columns:
            repeated.append(block)
    elsewhere = f"What the jobs of this machine took, beside these numbers: table {name}{SECONDS}."
    return sources.finished(name, title, repeated, (elsewhere, *footnotes))


def reported(sources: Sources, title: str) -> Block:
    """Return the paper's rows, with the smallest times and memories ranked best."""
    block = sources.reported(PAPER_DATA, title, families=False)
    return replace(block, lower_is_better=costs_of(block.columns))


def costs_of(columns: Iterable[str]) -> frozenset[str]:
    """Return the columns of times and memory, in which the smallest value is best."""
    return frozenset(column for column in columns if column.endswith(("(min)", "(GB)", "(s)")))


def quality_blocks(
    sources: Sources, time_columns: tuple[str, ...], methods: tuple[str, ...] = ("field", "tree")
) -> list[Block]:
    """Return mIoU and HC at given levels beside times, for each data set with queries at levels.

    Labels with levels have their own data set (Hi-LERF), or are the scenes' own.
    """
    if sources.scores.empty:
        return []
    quality_columns, blocks = ("Hi-LERF mIoU", "Hi-LERF HC"), []
    scores = with_seeds(sources.scores)
    given = scores[(scores["seed"] == "0") & scores["protocol"].str.startswith(LEVEL_GIVEN.full_name)]
    for data, costs in by_dataset(sources.costs).items():
        rows = []
        for variant, method, of_row in by_answer(sources, costs):
            part = given[
                given["dataset"].isin([*LEVELLED, data])
                & given["scene"].isin([cost.scene for cost in of_row])
                & (given["variant"] == variant)
                & (given["method"] == method)
            ]
            if method not in methods or part.empty:
                continue
            quality = component_cells(scores, part)
            query_s = statistics.fmean(cost.query_s[method] for cost in of_row)
            cells = {name: quality[name] for name in quality_columns} | time_cells(of_row)
            names = {"Method": row_name(variant, method, sources.labels)}
            rows.append(Row(names, {**cells, "Query (s)": Cell.number(query_s)}))
        columns = (*quality_columns, *time_columns)
        blocks.append(Block(*kind_and_title(data), tuple(rows), columns, costs_of(columns)))
    return blocks


def time_cells(costs: list[Cost]) -> dict[str, Cell]:
    """Return mean times over scenes and the maximum memory."""
    return {
        "Preparation (min)": Cell.number(statistics.fmean(cost.prepare_s for cost in costs) / 60),
        "Training (min)": Cell.number(statistics.fmean(cost.train_s for cost in costs) / 60),
        "Memory (GB)": Cell.number(max(cost.peak_mib for cost in costs) / 1024),
    }


def by_dataset(costs: Iterable[Cost]) -> dict[str, list[Cost]]:
    """Group costs by data set, sorted by name."""
    found: dict[str, list[Cost]] = {}
    for cost in sorted(costs, key=lambda cost: (cost.dataset, cost.scene)):
        found.setdefault(cost.dataset, []).append(cost)
    return found


def by_answer(sources: Sources, costs: list[Cost]) -> list[tuple[str, str, list[Cost]]]:
    """Return (variant, method, costs of the scenes) in row order."""
    order = ["default", *sources.labels]
    found: dict[tuple[str, str], list[Cost]] = {}
    for cost in costs:
        for method in cost.query_s:
            found.setdefault((cost.variant, method), []).append(cost)

    def place(key: tuple[str, str]) -> tuple:
        variant, method = key
        known = order.index(variant) if variant in order else len(order)
        return known, variant, list(ANSWERS).index(method)

    return [(*key, found[key]) for key in sorted(found, key=place)]
