"""Measured rows of the tables of time, memory and quality."""

import statistics
from dataclasses import replace

import numpy as np

from hilsplat.configuration import seed_parts
from hilsplat.datasets.sources import LEVELLED
from hilsplat.evaluate.costs import Cost
from hilsplat.evaluate.protocols.cards import LEVEL_GIVEN
from hilsplat.evaluate.tables.ablation import component_cells
from hilsplat.evaluate.tables.kinds import TableKind
from hilsplat.evaluate.tables.measured import (
    kind_and_title,
    mean_over_seeds,
    of_comparable_seeds,
    row_name,
    row_of_scenes,
    row_place,
    seeds_of_row,
    with_seeds,
)
from hilsplat.evaluate.tables.rows import Block, Cell, Sources


def cost_blocks(kind: TableKind, sources: Sources) -> list[Block]:
    """Return times, memory and seconds per query in each scene."""
    blocks = []
    for data, answers in by_answer(sources).items():
        rows, scenes = [], scenes_of(answers)
        for variant, method, costs in answers:
            of_scenes = {cost.scene: [each for each in costs if each.scene == cost.scene] for cost in costs}
            queries = {
                f"{scene} query (s)": time_cells(of_scene, method)["Query (s)"]
                for scene, of_scene in of_scenes.items()
            }
            names = {"Method": row_name(variant, method, sources.labels)}
            rows.append(row_of_scenes(names, time_cells(costs, method) | queries, data, of_scenes, scenes))
        blocks.append(Block(*kind_and_title(data), tuple(rows), kind.columns_of(scenes)))
    return blocks


def quality_blocks(kind: TableKind, sources: Sources) -> list[Block]:
    """Return mIoU and HC at given levels beside times, for each data set whose queries have levels.

    Labels with levels are a separate data set (Hi-LERF) or belong to the scene's own data set.
    """
    blocks = []
    scores = with_seeds(sources.scores)
    given = scores[scores["protocol"].str.startswith(LEVEL_GIVEN.full_name)]
    for data, answers in by_answer(sources).items():
        rows, scenes = [], scenes_of(answers)
        for variant, method, costs in answers:
            part = given[
                given["dataset"].isin([*LEVELLED, data])
                & given["scene"].isin([cost.scene for cost in costs])
                & (given["variant"] == variant)
                & (given["method"] == method)
            ]
            if method in kind.methods and not part.empty:
                part = of_comparable_seeds(part)
                seeds = [component_cells(scores, of_seed) for _, of_seed in part.groupby("seed", sort=True)]
                times = time_cells([cost for cost in costs if cost.scene in set(part["scene"])], method)
                names = {"Method": row_name(variant, method, sources.labels)} | seeds_of_row(seeds)
                cells = mean_over_seeds(seeds) | times
                rows.append(row_of_scenes(names, cells, data, part["scene"], scenes))
        blocks.append(Block(*kind_and_title(data), tuple(rows), kind.columns_of(())))
    return blocks


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


def scenes_of(answers: list[tuple[str, str, list[Cost]]]) -> set[str]:
    return {cost.scene for *_, costs in answers for cost in costs}


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
