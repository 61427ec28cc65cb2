"""Measure how time and memory of the stages after the fit grow with Gaussians, views, pixels and masks.

    python -m benchmarks.growth FOLDER                    # sixteen scenes
    python -m benchmarks.growth FOLDER --quantity views   # 250 to 2,000 views of one place

Each series generates scenes of `large_scene` in which one quantity grows by factors of two, and runs every
stage in its own process. Times are CPU seconds, which other work on the machine changes less. The script
writes `growth.json` and `growth.png`, and prints exponents of the last doubling: 1 is linear growth. Existing
results are reused.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from benchmarks.large_scene import STAGES
from benchmarks.table import markdown_table

FACTORS = (0.5, 1.0, 2.0, 4.0)
VIEWS = (250, 500, 1000, 2000)
GAUSSIANS = (500_000, 1_000_000, 2_000_000, 4_000_000)
MEASURES = ("CPU seconds", "MiB")
LABELS = {
    "gaussians": "Gaussians",
    "views": "views",
    "pixels": "pixels per view",
    "masks": "masks per view",
}


@dataclass(frozen=True)
class Size:
    """Size of a generated scene; pixels and masks (of all levels) are per view."""

    gaussians: int = 50_000
    views: int = 24
    pixels: int = 400 * 300
    masks: int = 150

    def grown(self, quantity: str, factor: float) -> "Size":
        """Return the size with one quantity multiplied."""
        return replace(self, **{quantity: round(getattr(self, quantity) * factor)})

    def options(self) -> list[str]:
        """Return the options of `large_scene`; views are 4 : 3."""
        width = round((self.pixels * 4 / 3) ** 0.5)
        sizes = {"gaussians": self.gaussians, "views": self.views, "masks": self.masks}
        sizes |= {"width": width, "height": round(width * 3 / 4)}
        return [part for name, size in sizes.items() for part in (f"--{name}", str(size))]


SERIES = {name: [Size().grown(name, factor) for factor in FACTORS] for name in LABELS}
SERIES["views"] = [Size(views=views, pixels=200 * 150, masks=300) for views in VIEWS]
SERIES["gaussians"] = [Size(gaussians=gaussians, views=48) for gaussians in GAUSSIANS]
"""Quantity -> sizes of its scenes. Large numbers of views have small pictures with many masks."""


def measured(size: Size, folder: Path) -> dict[str, list[float]]:
    """Return seconds, CPU seconds and peak MiB of every stage; existing timings are reused."""
    name = f"{size.gaussians}-{size.views}-{size.pixels}-{size.masks}"
    recorded = folder / name / "times.json"
    if not recorded.exists():
        command = [sys.executable, "-m", "benchmarks.large_scene", str(folder / name), *size.options()]
        subprocess.run(command, check=True, stdout=sys.stderr)
    return json.loads(recorded.read_text(encoding="utf-8"))


def exponent(sizes: list[float], values: list[float]) -> float:
    """Return the exponent of the growth from the last but one value to the last; 1 is linear growth."""
    return float(np.log(values[-1] / values[-2]) / np.log(sizes[-1] / sizes[-2]))


def draw(series: dict[str, dict[str, dict[str, list[float]]]]) -> Figure:
    """Draw a column per quantity, seconds above and peak memory below, with the exponent of each line."""
    figure = Figure(figsize=(3.6 * len(series), 6.4), layout="constrained")
    panels = figure.subplots(len(MEASURES), len(series), sharey="row", squeeze=False)
    for column, (quantity, measures) in enumerate(series.items()):
        sizes = measures["size"]["values"]
        for row, measure in enumerate(MEASURES):
            axes = panels[row, column]
            for stage in STAGES:
                values = measures[stage][measure]
                (line,) = axes.loglog(sizes, values, marker="o", markersize=3, label=stage.replace("_", " "))
                axes.annotate(
                    f"{exponent(sizes, values):.1f}".replace("-0.0", "0.0"),
                    (sizes[-1], values[-1]),
                    xytext=(5, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=8,
                    color=line.get_color(),
                )
            axes.set_xlim(sizes[0] / 1.2, sizes[-1] * 1.7)
            axes.set_xticks(sizes, [f"{size:,.0f}" for size in sizes])
            axes.minorticks_off()
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.grid(alpha=0.3)
            axes.set_xlabel(LABELS[quantity])
        panels[0, 0].set_ylabel("CPU seconds")
        panels[1, 0].set_ylabel("peak memory, MiB")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(STAGES))
    return figure


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--quantity", choices=SERIES, action="append", help="quantity to measure; default: all"
    )
    given = parser.parse_args()
    folder = given.out
    series: dict[str, dict[str, dict[str, list[float]]]] = {}
    for quantity in given.quantity or SERIES:
        sizes = SERIES[quantity]
        times = [measured(size, folder) for size in sizes]
        series[quantity] = {"size": {"values": [float(getattr(size, quantity)) for size in sizes]}}
        for stage in STAGES:
            columns = zip(*(each[stage] for each in times), strict=True)
            series[quantity][stage] = dict(zip(("seconds", *MEASURES), map(list, columns), strict=True))
    (folder / "growth.json").write_text(json.dumps(series, indent=1) + "\n", encoding="utf-8")
    draw(series).savefig(folder / "growth.png", dpi=110)
    rows = [
        (
            stage,
            *(
                f"{exponent(found['size']['values'], found[stage][measure]):.2f}"
                for found in series.values()
                for measure in MEASURES
            ),
        )
        for stage in STAGES
    ]
    head = ("exponent", *(f"{quantity}: {measure}" for quantity in series for measure in MEASURES))
    print(markdown_table(head, rows))


if __name__ == "__main__":
    main()
