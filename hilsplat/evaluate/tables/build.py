"""Build any table by name, in about a second: imports neither torch nor other slow packages."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from hilsplat.base.artifacts import write_text
from hilsplat.base.errors import ArtifactError, shorten_list
from hilsplat.base.files import project_path
from hilsplat.base.tables import write_csv
from hilsplat.evaluate.costs import read_costs
from hilsplat.evaluate.scores import read_instances, read_scores
from hilsplat.evaluate.tables.cost_tables import cost_blocks, quality_blocks, without_costs
from hilsplat.evaluate.tables.formats import as_html, as_latex, as_markdown, csv_rows
from hilsplat.evaluate.tables.image_tables import (
    ablation_blocks,
    frames_blocks,
    hierarchy_cells,
    lerf_cells,
    ovs_cells,
)
from hilsplat.evaluate.tables.kinds import NOTES, SECONDS, TABLES, TableKind
from hilsplat.evaluate.tables.measured import measured_blocks
from hilsplat.evaluate.tables.point_tables import interval_cells, replica_cells, scannet_blocks, waymo_cells
from hilsplat.evaluate.tables.rows import Block, Sources, Table, read_published, reported_block
from hilsplat.segment.origin import made_from_truth

logger = logging.getLogger(__name__)

BLOCKS: dict[str, Callable[[TableKind, Sources], list[Block]]] = {
    "lerf": partial(measured_blocks, cells_of=lerf_cells),
    "3dovs": partial(measured_blocks, cells_of=ovs_cells),
    "replica": partial(measured_blocks, cells_of=replica_cells, over_seeds=interval_cells),
    "scannet": scannet_blocks,
    "waymo": partial(measured_blocks, cells_of=waymo_cells, over_seeds=interval_cells),
    "hierarchy": partial(measured_blocks, cells_of=hierarchy_cells),
    **dict.fromkeys(("ablation", "components", "theta", "omega"), ablation_blocks),
    "cost": cost_blocks,
    **dict.fromkeys(("pruning", "efficiency"), quality_blocks),
    **dict.fromkeys(("frames-hi-lerf", "frames-hi-3dovs"), frames_blocks),
}
"""Table (without `-seconds`) -> function that returns its measured rows."""


TIMES = {
    "unrecorded": "{}, whose benchmark files are missing; --forcerun runs the stages again.",
    "partial": "the time of views that these jobs read from the cache, as after an interruption: {}.",
}
"""Attribute of a cost that lists stages -> the note below tables of times, with the names of their jobs."""


def published_values(table: str) -> Path:
    """Return the file with the paper's values for a table; a `-seconds` table uses the main table's file."""
    return project_path(f"config/published/{table.removesuffix(SECONDS)}.csv")


def run_table(
    name: str,
    scores: Sequence[Path],
    published: Path,
    labels: Mapping[str, str],
    out: Path,
    absent: Sequence[str] = (),
) -> None:
    """Build one table and write it as CSV, Markdown, LaTeX and HTML; equal tables produce identical files.

    Args:
        published: file with the paper's values, `published_values(name)`.
        labels: variant -> its name in the table; other variants keep their own names.
        absent: a sentence with the reason for each data set that was not measured.

    Raises:
        ArtifactError: the table is unknown, or a file is missing or has different columns.
    """
    if name not in TABLES:
        raise ArtifactError(f"there is no table {name!r}", expected=f"one of {', '.join(TABLES)}")
    costs = read_costs(scores) if TABLES[name].shows_costs else ()
    sources = Sources(read_published(published), read_scores(scores), labels, costs, read_instances(scores))
    table, out = table_of(name, sources, absent), Path(out)
    write_text(out.with_suffix(".md"), as_markdown(table))
    write_text(out.with_suffix(".tex"), as_latex(table))
    write_text(out.with_suffix(".html"), as_html(table))
    write_csv(out, *csv_rows(table))
    if scores and all(block.kind == "reported" for block in table.blocks):
        logger.warning("no score in %s is of table %s", shorten_list([*map(str, scores)]), name)
    rows = sum(len(block.rows) for block in table.blocks)
    logger.info("table %s: %d blocks, %d rows", name, len(table.blocks), rows)


def table_of(name: str, sources: Sources, absent: Sequence[str]) -> Table:
    """Return a table with the paper's blocks, measured blocks, and its footnotes."""
    kind = TABLES[name]
    reported = [reported_block(sources.published, **description) for description in kind.reported]
    measured = BLOCKS[name.removesuffix(SECONDS)](kind, sources)
    if kind.shows_costs and not name.endswith(SECONDS):
        measured = [block for block in map(without_costs, measured) if block.columns]
    blocks = tuple(block for block in (*reported, *measured) if block.rows)
    costs = sources.costs if name.endswith(SECONDS) else ()
    sentences = [*absent]
    for kind_of_job, sentence in TIMES.items():
        names = [(cost, stage) for cost in costs for stage in getattr(cost, kind_of_job)]
        jobs = dict.fromkeys(f"{stage} of {cost.dataset}/{cost.scene}" for cost, stage in names)
        sentences += [sentence.format(shorten_list([*jobs]))] if jobs else []
    not_measured = [f"Not measured: {sentence}" for sentence in sentences]
    return Table(name, kind.title, blocks, (*_warnings(blocks), *kind.footnotes, *not_measured))


def _warnings(blocks: Sequence[Block]) -> Iterator[str]:
    rows = [row for block in blocks for row in block.rows]
    if any(block.kind == "synthetic stand-in" for block in blocks):
        yield NOTES["stand-in"]
    if any(made_from_truth(row.names.get("Masks", "")) for row in rows):
        yield NOTES["true masks"]
    if any("Seeds" in row.names for row in rows):
        yield NOTES["seeds"]
    if any("Scenes" in row.names for row in rows):
        yield NOTES["scenes"]
