"""Plans of small scene sheets, and jobs in them."""

from dataclasses import dataclass
from pathlib import Path

from hilsplat.workflow.plan import Plan

BENCHMARK = (
    "synthetic one benchmark world:tabletop:1 metre",
    "synthetic two benchmark world:tabletop:2 metre",
)
"""Rows of two synthetic scenes."""


@dataclass(frozen=True)
class Job:
    """Wildcards of a variant's rule."""

    dataset: str = "synthetic"
    scene: str = "one"
    variant: str = "default"


def write_sheet(path: Path, rows: tuple[str, ...] = BENCHMARK) -> Path:
    """Write a scene sheet; the cells of a row are separated by spaces."""
    path.parent.mkdir(exist_ok=True)
    lines = [row.replace(" ", "\t") for row in ("dataset scene group source unit", *rows)]
    path.write_text("\n".join([*lines, ""]))
    return path


def plan_of(folder: Path, rows: tuple[str, ...] = BENCHMARK, **config: object) -> Plan:
    """Return the plan of a sheet that is written to a folder; by default, its tables have all variants."""
    sheet = write_sheet(folder / "config/scenes.tsv", rows)
    main_variants = ["default", *config.get("variants", ())]
    return Plan({"scenes": str(sheet), "main_variants": main_variants, **config})
