"""Plots of the sweeps over theta and Omega, from their finished tables."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from hilsplat.base.errors import ArtifactError
from hilsplat.query.pictures import save_png_and_pdf

KNOBS = {"theta": "coverage threshold theta", "omega": "similarity degree Omega"}
COLUMNS = ("Hi-LERF mIoU", "Hi-LERF HC", "3D-OVS mIoU", "LERF mIoU")
DEFAULTS = {"theta": 0.9, "omega": 10.0}
"""Values of the default variant, which its row doesn't state."""


@dataclass(frozen=True)
class Line:
    """One curve: (setting, percentage) pairs, sorted by the setting."""

    kind: str
    column: str
    points: tuple[tuple[float, float], ...]


def run_sweep_plot(name: str, table: Path, out: Path, default: float | None = None) -> None:
    """Draw a sweep as PNG and PDF: the paper's curves and ours, each kind in its own panel.

    Args:
        table: the finished CSV of the table with this name.
        out: PNG; the PDF is written beside it.
        default: value for rows that don't state one; by default that of the default variant.

    Raises:
        ArtifactError: the sweep is unknown, or the table is missing.
    """
    if name not in KNOBS:
        raise ArtifactError(f"there is no sweep {name!r}", expected=f"one of {', '.join(KNOBS)}")
    lines = read_lines(table, DEFAULTS[name] if default is None else default)
    save_png_and_pdf(draw_sweep(name, lines), out)


def read_lines(table: Path, default: float) -> list[Line]:
    """Return the curves of a table: one per kind of row and column with at least two values."""
    try:
        with Path(table).open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
    except FileNotFoundError as error:
        raise ArtifactError(f"{table} is missing", fix="build the table first") from error
    lines = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        for column in COLUMNS:
            points = []
            for row in rows:
                shown = re.match(r"[-0-9.]+", row.get(column) or "")
                if row["kind"] == kind and shown:
                    named = re.search(r"= ([0-9.]+)", row["method"])
                    points.append((float(named[1]) if named else default, float(shown[0])))
            if len(points) > 1:
                lines.append(Line(kind, column, tuple(sorted(points))))
    return lines


def draw_sweep(name: str, lines: Sequence[Line]) -> Figure:
    """Draw one panel per kind of row; axes are not shared because the kinds are not comparable."""
    kinds = list(dict.fromkeys(line.kind for line in lines)) or ["reported"]
    figure = Figure(figsize=(4.6 * len(kinds), 3.4), layout="constrained")
    for axes, kind in zip(figure.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
        for line in lines:
            if line.kind == kind:
                values, shares = zip(*line.points, strict=True)
                axes.plot(values, shares, marker="o", label=line.column)
        if name == "omega":
            axes.set_xscale("log")
        axes.set_xlabel(KNOBS[name])
        axes.set_ylabel("%")
        axes.set_title(kind if kind == "reported" else f"{kind}, not comparable", fontsize=10)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure
