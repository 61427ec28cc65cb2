"""Measured rows of the tables of time, memory and quality."""

import statistics
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hilsplat.configuration import seed_parts
from hilsplat.datasets.sources import LEVELLED
from hilsplat.evaluate.costs import Cost
from hilsplat.evaluate.tables.image_tables import component_cells
from hilsplat.evaluate.tables.kinds import TableKind
from hilsplat.evaluate.tables.measured import kind_and_title, measured_blocks, row_name, row_of, row_place
from hilsplat.evaluate.tables.rows import Block, Cell, Sources

if TYPE_CHECKING:
    import pandas as pd


def cost_blocks(kind: TableKind, sources: Sources) -> list[Block]:
    """Return times, memory and seconds per query in each scene."""
    blocks = []
    for data, answers in by_answer(sources).items():
        rows, scenes = [], {cost.scene for *_, costs in answers for cost in costs}
        for variant, method, costs in answers:
            of_scenes = {
                cost.scene: [other for other in costs if other.scene == cost.scene] for cost in costs
            }
            times = {scene: time_cells(of_scene, method) for scene, of_scene in of_scenes.items()}
            queries = {f"{scene} query (s)": cells["Query (s)"] for scene, cells in times.items()}
            names = {"Method": row_name(variant, method, sources.labels)}
            rows.append(row_of(names, time_cells(costs, method) | queries, data, of_scenes, scenes))
        blocks.append(Block(*kind_and_title(data), tuple(rows), kind.columns_of(scenes)))
    return blocks


def quality_blocks(kind: TableKind, sources: Sources) -> list[Block]:
    """Return mIoU and HC at given levels beside times, for each data set whose queries have levels.

    Labels with levels are a separate data set (Hi-LERF) or belong to the scene's own data set.
    """

    def times(_: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
        first, scenes = part.iloc[0], set(part["scene"])
        costs = [
            cost
            for cost in sources.costs
            if first["dataset"] in (cost.dataset, *LEVELLED)
            and cost.scene in scenes
            and seed_parts(cost.variant)[0] == first["variant"]
            and first["method"] in cost.query_s
        ]
        return time_cells(costs, first["method"]) if costs else {}

    return measured_blocks(kind, sources, component_cells, times)


def without_costs(block: Block) -> Block:
    return replace(block, columns=tuple(column for column in block.columns if column not in block.costs))


def time_cells(costs: list[Cost], method: str) -> dict[str, Cell]:
    """Return the mean times and the maximum memory over scenes and seeds, for rows of `method`."""
    peaks_mib = [cost.peak_mib for cost in costs]
    return {
        "Preparation (min)": Cell.number(statistics.fmean(cost.prepare_s for cost in costs) / 60),
        "Training (min)": Cell.number(statistics.fmean(cost.train_s for cost in costs) / 60),
        "Memory (GB)": Cell.number(float(np.max(peaks_mib)) / 1024),  # nan if any is unknown
        "Query (s)": Cell.number(statistics.fmean(cost.query_s[method] for cost in costs)),
    }


def by_answer(sources: Sources) -> dict[str, list[tuple[str, str, list[Cost]]]]:
    """Map each data set, sorted by name, to (variant, method, costs of scenes and seeds) in row order."""
    groups: dict[tuple[str, str, str], list[Cost]] = {}
    for cost in sorted(sources.costs, key=lambda cost: cost.scene):
        for method in cost.query_s:
            groups.setdefault((cost.dataset, seed_parts(cost.variant)[0], method), []).append(cost)
    rows: dict[str, list[tuple[str, str, list[Cost]]]] = {}
    for data, variant, method in sorted(groups, key=lambda key: row_place(key[1], key[2], sources.labels)):
        rows.setdefault(data, []).append((variant, method, groups[data, variant, method]))
    return {data: rows[data] for data in sorted(rows)}
