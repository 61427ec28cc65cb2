"""Time from photographs to query results with a full-size SAM and CLIP, in a complete run on two cores.

    python -m benchmarks.rehearsal FOLDER                       # SAM 2.1 small, CLIP B/16, default settings
    python -m benchmarks.rehearsal FOLDER --sam base --precision fp32

Full-size networks with random weights (`real_size`) take as long as trained ones, but a random SAM predicts
no confident mask. Its networks therefore run in full, and their masks are replaced by the graph segmenter's
regions at each prompt (`canned_outputs`), so that later stages process realistic masks. The regions are kept
beside the exported models, so the second run of a set of photographs doesn't compute them. FOLDER becomes a
project with one scene. An existing FOLDER is refused, because its caches would be used.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.real_size import PHOTOGRAPHS, SIZES, export_missing

PROJECT = Path(__file__).resolve().parents[1]
SCENE = "photos/rehearsal"
READY, COMPLETE = "is ready to query", "uses all photographs"

PATCH = """
import importlib.abc, importlib.util, sys

class Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name != "hilsplat.segment.sam":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        load = spec.loader.exec_module
        def exec_module(module):
            load(module)
            from pathlib import Path
            from benchmarks.canned_outputs import replace_outputs
            replace_outputs(module.SamModel, Path({regions!r}))
        spec.loader.exec_module = exec_module
        return spec

sys.meta_path.insert(0, Finder())
"""
"""`sitecustomize.py` of all processes of the run, which patches SAM with canned outputs on import."""


def make_project(folder: Path, models: dict[str, Path], regions: Path, precision: str) -> list[str]:
    """Make a project with links to the code and the models, and return the options of its run."""
    for name in ("Snakefile", "workflow", "rules", "profiles"):
        (folder / name).symlink_to(PROJECT / name)
    shutil.copytree(PROJECT / "config", folder / "config")
    (folder / "models").mkdir()
    for name in ("sam-tiny", "clip-tiny"):
        (folder / "models" / name).symlink_to(PROJECT / "models" / name)
    for kind, folder_of_model in models.items():
        (folder / "models" / f"rehearsal-{kind}").symlink_to(folder_of_model.resolve())
    (folder / "patch").mkdir()
    (folder / "patch/sitecustomize.py").write_text(PATCH.format(regions=str(regions)))
    if precision == "auto":
        return []
    fixed = {"overrides": {"photos": {kind: {"precision": precision} for kind in ("masks", "clip")}}}
    (folder / "precision.yaml").write_text(json.dumps(fixed))
    return ["--config", "precision.yaml"]


def rehearse(folder: Path, photographs: Path, options: list[str], cores: int) -> dict[str, float]:
    """Run the project; return the seconds from the end of `hilsplat new` to each milestone and to the end."""
    environment = {**os.environ, "PYTHONPATH": f"{folder / 'patch'}:{PROJECT}"}
    command = [sys.executable, "-m", "hilsplat"]
    name = SCENE.partition("/")[2]
    # As in `hilsplat models get`, this compiles kernels and makes int8 networks before the timed run.
    plain = {**os.environ, "PYTHONPATH": str(PROJECT)}
    subprocess.run([*command, "models", "check"], cwd=folder, env=plain, check=True)
    subprocess.run([*command, "new", name, str(photographs)], cwd=folder, env=environment, check=True)
    begin = time.monotonic()
    moments: dict[str, float] = {}
    run = [*command, "run", SCENE, *options, "--", "--cores", str(cores)]
    with subprocess.Popen(
        run, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            now = time.monotonic() - begin
            print(f"{now:6.0f} s  {line}", end="", flush=True)
            for what, words in (("first answer", READY), ("final tree", COMPLETE)):
                if words in line:
                    moments.setdefault(what, now)
    moments["end"] = time.monotonic() - begin
    if process.returncode:
        sys.exit("the run failed")
    return moments


def stage_table(folder: Path) -> str:
    """Return time, processor time and peak memory of every job, from Snakemake's benchmark files."""
    lines = [f"{'job':32} {'s':>6} {'core s':>7} {'peak MiB':>9}"]
    for path in sorted((folder / "results" / SCENE).rglob("benchmarks/*.jsonl"), key=os.path.getmtime):
        row = json.loads(path.read_text().splitlines()[-1])
        job = "/".join([*path.relative_to(folder / "results" / SCENE).parts[:-2], path.stem])
        lines.append(f"{job:32} {row['s']:6.0f} {row['cpu_time']:7.0f} {row['max_rss']:9.0f}")
    return "\n".join(lines)


def main() -> None:
    """Export the models, make the project, run it, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder to make")
    parser.add_argument("photographs", type=Path, nargs="?", default=PHOTOGRAPHS)
    parser.add_argument("--sam", choices=[*SIZES, "sam2.1-small"], default="sam2.1-small")
    parser.add_argument("--precision", choices=["auto", "fp32", "int8"], default="auto")
    parser.add_argument(
        "--models", type=Path, default=Path("results/.cache/real-size"), help="exported models"
    )
    parser.add_argument("--cores", type=int, default=2)
    given = parser.parse_args()
    if not given.photographs.is_dir():
        print(f"skipped: {given.photographs} does not exist; pass a folder of photographs")
        return
    if given.folder.exists():
        sys.exit(f"{given.folder} exists, and its caches would shorten the run; pass a new folder")
    models_folder = given.models.resolve()
    models = export_missing(models_folder, given.sam)
    given.folder.mkdir(parents=True)
    folder = given.folder.resolve()
    options = make_project(folder, models, models_folder / "regions", given.precision)
    moments = rehearse(folder, given.photographs.resolve(), options, given.cores)
    print(stage_table(folder))
    print(", ".join(f"{what} after {seconds:.0f} s" for what, seconds in moments.items()))


if __name__ == "__main__":
    main()
