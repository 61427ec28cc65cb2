"""Plots of the sweeps over theta and Omega, drawn from the finished tables."""

import re
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from hilsplat.base.errors import ArtifactError
from hilsplat.base.tables import read_csv
from hilsplat.query.pictures import save_with_pdf

SWEEPS = {"theta": ("coverage threshold theta", 0.9), "omega": ("similarity degree Omega", 10.0)}
"""Sweep -> axis label, and the setting of the default variant, which its table row doesn't state."""

COLUMNS = ("Hi-LERF mIoU", "Hi-LERF HC", "3D-OVS mIoU", "LERF mIoU")

Lines = Mapping[tuple[str, str], list[tuple[float, float]]]


def run_sweep_plot(name: str, table: Path, out: Path) -> None:
    """Draw a sweep as PNG and PDF, from the finished CSV of the table called `name`.

    Raises:
        ArtifactError: the sweep is unknown, or the table is missing.
    """
    if name not in SWEEPS:
        raise ArtifactError(f"there is no sweep {name!r}", expected=f"one of {', '.join(SWEEPS)}")
    save_with_pdf(draw_sweep(name, read_lines(table, SWEEPS[name][1])), out)


def read_lines(table: Path, default: float) -> Lines:
    """Map (kind of row, column) to sorted (setting, percentage) pairs; a curve has at least two."""
    rows = read_csv(table, None, "build the table first")
    lines = {}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        for column in COLUMNS:
            points = []
            for row in rows:
                shown = re.match(r"[-0-9.]+", row.get(column) or "")
                if row["kind"] == kind and shown:
                    named = re.search(r"= ([0-9.]+)", row["method"])
                    points.append((float(named[1]) if named else default, float(shown[0])))
            if len(points) > 1:
                lines[kind, column] = sorted(points)
    return lines


def draw_sweep(name: str, lines: Lines) -> Figure:
    """Draw one panel per kind of row; axes are not shared because the kinds are not comparable."""
    kinds = list(dict.fromkeys(kind for kind, _ in lines)) or ["reported"]
    figure = Figure(figsize=(4.6 * len(kinds), 3.4), layout="constrained")
    for axes, kind in zip(figure.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
        for (of_kind, column), points in lines.items():
            if of_kind == kind:
                values, shares = zip(*points, strict=True)
                axes.plot(values, shares, marker="o", label=column)
        if name == "omega":
            axes.set_xscale("log")
        axes.set_xlabel(SWEEPS[name][0])
        axes.set_ylabel("%")
        axes.set_title(kind if kind == "reported" else f"{kind}, not comparable", fontsize=10)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure
