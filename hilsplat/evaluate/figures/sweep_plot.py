"""Plots of the sweeps over theta and Omega, drawn from the finished tables."""

import re
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from hilsplat.base.errors import ArtifactError
from hilsplat.base.tables import read_csv
from hilsplat.query.pictures import save_with_pdf

SWEEPS = {"theta": "coverage threshold theta", "omega": "similarity degree Omega"}  # sweep -> axis label

COLUMNS = ("Hi-LERF mIoU", "Hi-LERF HC", "3D-OVS mIoU", "LERF mIoU")
"""Columns that are plotted, each in a colour of its own."""
LINES = ("-", "--", ":", "-.")  # lines of several curves of a column

Curves = Mapping[str, Mapping[str, list[tuple[float, float]]]]


def run_sweep_plot(name: str, table: Path, out: Path) -> None:
    """Draw a sweep as PNG and PDF, from the finished CSV of the table called `name`.

    Raises:
        ArtifactError: the sweep is unknown, or the table is missing or another.
    """
    if name not in SWEEPS:
        raise ArtifactError(f"there is no sweep {name!r}", expected=f"one of {', '.join(SWEEPS)}")
    if not (curves := read_curves(table)):
        raise ArtifactError(f"{table} is not the table of a sweep", expected="rows named like 'theta = 0.9'")
    save_with_pdf(draw_sweep(name, curves), out)


def read_curves(table: Path) -> Curves:
    """Map each panel (kind of rows and data set) to its curves, by name: (setting, percentage) pairs.

    Rows of a curve have the same masks and settings of the protocol, and names that differ only in the
    setting, such as "theta = 0.6, by head".
    """
    panels: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for row in read_csv(table, None, "build the table first"):
        named = re.fullmatch(r"\w+ = ([0-9.]+)(?:, )?(.*)", row["method"])
        departures = (row.get("protocol") or "").partition(" (")[2].removesuffix(")")
        for column in COLUMNS:
            if named and (number := re.match(r"[-0-9.]+", row.get(column) or "")):
                curve = ", ".join(filter(None, (column, named[2], row.get("masks"), departures)))
                curves = panels.setdefault(f"{row['kind']}: {row['data']}", {})
                curves.setdefault(curve, []).append((float(named[1]), float(number[0])))
    return panels


def draw_sweep(name: str, curves: Curves) -> Figure:
    """Draw one panel per kind of rows and data set; axes are not shared because these are not comparable."""
    figure = Figure(figsize=(4.6 * len(curves), 3.4), layout="constrained")
    all_axes = figure.subplots(1, len(curves), squeeze=False)[0]
    for axes, (panel, points_of) in zip(all_axes, curves.items(), strict=True):
        drawn: list[str] = []
        for label, points in points_of.items():
            values, shares = zip(*sorted(points), strict=True)
            column = label.partition(", ")[0]
            line, colour = LINES[drawn.count(column) % len(LINES)], f"C{COLUMNS.index(column)}"
            axes.plot(values, shares, marker="o", label=label, linestyle=line, color=colour)
            drawn.append(column)
        if name == "omega":
            axes.set_xscale("log")
        axes.set_xlabel(SWEEPS[name])
        axes.set_ylabel("%")
        axes.set_title(panel if panel.startswith("reported") else f"{panel}, not comparable", fontsize=10)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure
