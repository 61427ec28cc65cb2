"""Rehearse config/paper.yaml: a tiny data root in each published layout, and the whole workflow over it.

    make published                                   # in a folder that is removed
    python -m tests.published --work FOLDER          # keeps data, project and results

Three small synthetic scenes (a table, a room, a street) are written as LERF-OVS, LERF-Mask, 3D-OVS, Hi-LERF,
Hi-3DOVS, ScanNet, ScanNet200, Replica and Waymo. The run takes `config/paper.yaml` with fewer steps and the
embedded models, and nothing else changed. Every table must have measured rows of every data set that it
shows, and the hours that the dry run predicts must be within a factor of 1.5 of what the run took; the exit
code is 1 otherwise.
"""

import argparse
import csv
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import yaml

from hilsplat.evaluate.tables.build import TABLES
from hilsplat_world.settings import WorldSettings
from hilsplat_world.stage import run_world
from tests.conftest import PROJECT
from tests.unit.datasets.writers import labelled, points
from tests.workflow.conftest import copy_project

WORLD = WorldSettings(views=12, image_px=128, arc_deg=100, objects=3, samples=1)
LABELLED = ("002.png", "006.png", "010.png")
SEED = 210

VARIANTS = yaml.safe_load((PROJECT / "config/paper.yaml").read_text(encoding="utf-8"))["variants"]

REDUCED = {
    "gaussians": {"iterations": 300, "max_gaussians": 8000, "densify_every": 50, "sh_degree": 1},
    "masks": {"model": "models/sam-tiny", "points_per_side": 16, "crop_layers": 0, "min_area_px": 8},
    "clip": {"model": "models/clip-tiny"},
    "semantic_tree": {"min_views": 2},
    "autoencoder": {"epochs": 30, "min_steps": 500},
    "evaluate": {"min_region_px": 30},
    "variants": {
        name: {"method": {"steps": 200, "pixel_step": 2}}
        for name, sections in VARIANTS.items()
        if "steps" in sections["method"]
    },
    "overrides": {group: {"poses": {"max_side_px": 128}} for group in ("scannet", "replica", "waymo")},
}
"""Fewer steps, fewer prompts and the embedded models."""

MEASURED = {
    "lerf": ("lerf_ovs", "lerf_mask"),
    "3dovs": ("3d_ovs",),
    "hierarchy": ("hi_lerf", "hi_3dovs"),
    "frames-hi-lerf": ("hi_lerf",),
    "frames-hi-3dovs": ("hi_3dovs",),
    **{name: (name,) for name in ("replica", "scannet", "waymo")},
    **dict.fromkeys(("ablation", "theta", "omega", "efficiency"), ("hi_lerf", "hi_3dovs")),
    "cost": (),
}
"""Table -> data sets whose measured rows it must have; any other table needs some measured row."""

FILLED = {
    "ablation": ("LERF localization", "LERF mIoU", "3D-OVS mIoU", "Hi-LERF mIoU", "Hi-LERF HC"),
    "scannet": ("19 classes mIoU", "ScanNet200 mIoU", "ScanNet200 AP"),
    "efficiency": ("Hi-LERF mIoU", "Hi-LERF HC"),
}
"""Table -> columns that some measured row must fill."""

LARGEST_FACTOR = 1.5


def write_data(work: Path, root: Path) -> None:
    """Write one scene of each data set below the data root, from synthetic scenes in `work`."""
    for kind in ("tabletop", "room", "street"):
        run_world(f"world:{kind}:{SEED}", WORLD, work / kind / "images", work / kind / "truth", threads=2)
    table = labelled.TrueWorld.open(work / "tabletop")
    labelled.write_lerf_ovs(table, root / "lerf_ovs", "figurines", LABELLED)
    labelled.write_hi(table, root / "hi_lerf", root / "lerf_ovs", "figurines", LABELLED, labelled.LERF_STEMS)
    labelled.write_lerf_mask(table, root / "lerf_mask", "figurines", LABELLED)
    labelled.write_3d_ovs(table, root / "3d_ovs", "sofa", LABELLED)
    labelled.write_hi(table, root / "hi_3dovs", root / "3d_ovs", "sofa", LABELLED, labelled.OVS_STEMS)
    points.write_room_as_scannet(work / "room", root / "scannet", "scene0000_00")
    points.write_room_as_replica(work / "room", root / "replica", "room_0")
    points.write_street_as_waymo(work / "street", root / "waymo" / "validation", "1000_segment")


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the data, run the workflow, check tables and estimate; 1 if something is missing."""
    parser = argparse.ArgumentParser(prog="python -m tests.published", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--work", type=Path, help="new folder that is kept")
    parser.add_argument("--cores", type=int, default=2)
    given = parser.parse_args(arguments)
    if given.work is None:
        with tempfile.TemporaryDirectory() as folder:
            return rehearse(Path(folder) / "rehearsal", given.cores)
    return rehearse(given.work.absolute(), given.cores)


def rehearse(work: Path, cores: int) -> int:
    """As `main`, in a folder that does not exist yet."""
    work.mkdir(parents=True)
    write_data(work / "worlds", work / "data")
    project = copy_project(PROJECT, work / "project", results=False)
    (project.root / "reduced.yaml").write_text(yaml.safe_dump({**REDUCED, "data_root": str(work / "data")}))
    command = [sys.executable, "-m", "hilsplat", "run"]
    command += ["--config", "config/paper.yaml", "--config", "reduced.yaml"]
    planned = project.run(*command, "--", "--cores", str(cores), "--dry-run").stdout
    estimate = planned[planned.index("Estimate for this run") :]
    print(estimate, flush=True)
    hours = float(re.findall(r"^all .* ([\d.]+) +[\d.]+$", estimate, re.MULTILINE)[0])
    start = time.monotonic()
    project.run(*command, "--", "--cores", str(cores))
    taken = (time.monotonic() - start) / 3600
    problems = unfilled(project.root / "results" / "tables")
    if not 1 / LARGEST_FACTOR <= taken / hours <= LARGEST_FACTOR:
        problems.append(f"the run took {taken:.2f} hours, and the dry run said {hours:.2f}")
    for problem in problems:
        print(problem)
    print(f"{taken * 60:.1f} min; the dry run said {hours * 60:.1f}; {len(problems)} problems")
    return int(bool(problems))


def unfilled(tables: Path) -> list[str]:
    """Tables without a measured row, or without one of a data set that they must show."""
    found = []
    for name in TABLES:
        with (tables / f"{name}.csv").open(encoding="utf-8") as stream:
            measured = [row for row in csv.DictReader(stream) if row["kind"] == "measured"]
        if not measured and name not in MEASURED:
            found.append(f"table {name} has no measured row")
        missing = {*MEASURED.get(name, ())} - {row["data"] for row in measured}
        found += [f"table {name} has no measured row of {dataset}" for dataset in sorted(missing)]
        for column in FILLED.get(name, ()):
            if not any(row.get(column) for row in measured):
                found.append(f"no measured row of table {name} has a value in column {column}")
    return found


if __name__ == "__main__":
    sys.exit(main())
