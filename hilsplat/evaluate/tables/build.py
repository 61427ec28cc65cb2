"""Build any table by name, in about a second: imports neither torch nor other slow packages."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from hilsplat.base.artifacts import write_text
from hilsplat.base.errors import ArtifactError
from hilsplat.base.files import project_path
from hilsplat.base.tables import write_csv
from hilsplat.evaluate.scores import read_instances, read_scores
from hilsplat.evaluate.tables.ablation import ablation_table
from hilsplat.evaluate.tables.costs import SECONDS, cost_table, efficiency_table, pruning_table, read_costs
from hilsplat.evaluate.tables.formats import as_html, as_latex, as_markdown, csv_rows
from hilsplat.evaluate.tables.image_tables import frames_table, hierarchy_table, lerf_table, ovs_table
from hilsplat.evaluate.tables.point_tables import replica_table, scannet_table, waymo_table
from hilsplat.evaluate.tables.rows import Sources, Table, read_published

logger = logging.getLogger(__name__)

LEVELLED = ("tabletop", "lerf_ovs", "3d_ovs")
"""Data used for the ablations: the synthetic stand-in, and images with labels at levels."""


@dataclass(frozen=True)
class TableKind:
    """One table: its builder, the kinds of scenes and data sets that it covers, and its variants.

    `variants` is the configuration key that lists the variants. Tables of other variants than `main_variants`
    are measured only on the scenes in `sweep_scenes`. `shows_costs` adds job and query times.
    """

    build: Callable[[Sources], Table]
    data: tuple[str, ...]
    variants: str = "main_variants"
    shows_costs: bool = False


TABLES: dict[str, TableKind] = {
    "lerf": TableKind(lerf_table, ("tabletop", "lerf_ovs", "lerf_mask")),
    "3dovs": TableKind(ovs_table, ("tabletop", "3d_ovs")),
    "replica": TableKind(replica_table, ("room", "replica")),
    "scannet": TableKind(scannet_table, ("room", "scannet")),
    "waymo": TableKind(waymo_table, ("street", "waymo")),
    "hierarchy": TableKind(hierarchy_table, ("tabletop", "room", "street", "lerf_ovs", "3d_ovs")),
    "ablation": TableKind(partial(ablation_table, name="ablation"), LEVELLED, "ablation_variants"),
    "components": TableKind(partial(ablation_table, name="components"), LEVELLED, "component_variants"),
    "cost": TableKind(cost_table, LEVELLED, shows_costs=True),
    "cost-seconds": TableKind(partial(cost_table, seconds=True), LEVELLED, shows_costs=True),
    "pruning": TableKind(pruning_table, LEVELLED, "pruning_variants", shows_costs=True),
    "pruning-seconds": TableKind(
        partial(pruning_table, seconds=True), LEVELLED, "pruning_variants", shows_costs=True
    ),
    "efficiency": TableKind(efficiency_table, LEVELLED, shows_costs=True),
    "efficiency-seconds": TableKind(partial(efficiency_table, seconds=True), LEVELLED, shows_costs=True),
    "theta": TableKind(partial(ablation_table, name="theta"), LEVELLED, "theta_variants"),
    "omega": TableKind(partial(ablation_table, name="omega"), LEVELLED, "omega_variants"),
    "frames-hi-lerf": TableKind(partial(frames_table, data="Hi-LERF"), ("tabletop", "lerf_ovs")),
    "frames-hi-3dovs": TableKind(partial(frames_table, data="Hi-3DOVS"), ("tabletop", "3d_ovs")),
}
"""Every table by name, in report order; a new table needs a function and an entry here."""


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
    kind = TABLES[name]
    sources = Sources(
        read_published(published),
        read_scores(scores),
        labels,
        read_costs(scores) if kind.shows_costs else (),
        read_instances(scores),
        absent,
    )
    table, out = kind.build(sources), Path(out)
    write_text(out.with_suffix(".md"), as_markdown(table))
    write_text(out.with_suffix(".tex"), as_latex(table))
    write_text(out.with_suffix(".html"), as_html(table))
    write_csv(out, *csv_rows(table))
    rows = sum(len(block.rows) for block in table.blocks)
    logger.info("table %s: %d blocks, %d rows", name, len(table.blocks), rows)
