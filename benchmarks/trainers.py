"""Compare the field's fast solver with the literal trainer on one scene: losses, scores and time.

    python -m benchmarks.trainers FOLDER                        # dev-1, 6000 iterations, two seeds
    python -m benchmarks.trainers FOLDER --scene tiny --iterations 1000 --seeds 1

Both trainers minimise our reading of the paper's objective (variant `paper`) with equal masks, code and
weights. FOLDER becomes a project, and its results are kept. Losses are those of the whole objective, over all
views. The literal trainer's rate is constant, as in LangSplat; at LangSplat's 0.0025, noise increases the
objective by 1.5 %.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

from benchmarks.rehearsal import PROJECT
from hilsplat.base.artifacts import read_json
from hilsplat.evaluate.protocols.cards import LEVEL_GIVEN
from hilsplat.evaluate.scores import read_scores
from hilsplat.evaluate.tables.measured import level_cells
from hilsplat.settings import FieldSettings

PAPER = {
    "autoencoder": {"code": "network", "latent": 3, "targets": "mask"},
    "evaluate": {"methods": ["field"], "view_consistency": False},
}
OBJECTIVE = {
    "weight_clustering": 1.0,
    "weight_instance": 1e-6,
    "weight_part": 1e-5,
    "instance_mode": "literal",
    "part_mode": "literal",
    "min_labelled_share": 0,
}
TRAINERS = ("fast", "fast-60", "literal")
EMPTY = ("ablation", "component", "theta", "omega", "pruning")


def configuration(scene: str, iterations: int, seeds: int) -> dict[str, Any]:
    """Return the configuration: a variant per trainer; `fast-60` is the solver with many more steps."""
    literal = {"trainer": "literal", "rate": 0.001}
    more: tuple[dict[str, Any], ...] = ({}, {"cg_steps": 60, "lbfgs_steps": 20}, literal)
    trainers = dict(zip(TRAINERS, more, strict=True))
    return {
        "groups": ["benchmark", "development", "ci"],
        "only": [scene],
        "seeds": seeds,
        "variants": {
            name: {**PAPER, "field": {**OBJECTIVE, "iterations": iterations, **own}}
            for name, own in trainers.items()
        },
        "main_variants": ["default", *trainers],
        **{f"{name}_variants": [] for name in EMPTY},
    }


def main() -> None:
    """Run both trainers, and print a row for each field."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trainers", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scene", default="dev-1")
    parser.add_argument("--iterations", type=int, default=6000)
    parser.add_argument("--seeds", type=int, default=2)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    config = given.folder / "trainers.yaml"
    config.write_text(yaml.safe_dump(configuration(given.scene, given.iterations, given.seeds)))
    for name in ("models", "config"):
        if not (given.folder / name).exists():
            (given.folder / name).symlink_to(PROJECT / name)
    command = [sys.executable, "-m", "hilsplat", "run", "results/tables/hierarchy.csv"]
    command += ["--config", config.name]
    subprocess.run(command, cwd=given.folder, check=True)
    scene = given.folder / "results" / "synthetic" / given.scene
    print("| trainer, seed | objective | language | clustering | mIoU, level given | core s |")
    print("|---|---:|---:|---:|---:|---:|")
    for scores in sorted(scene.glob("*/scores.csv")):
        if scores.parent.name.partition(".")[0] in TRAINERS:
            print(row(scores.parent))


def row(variant: Path) -> str:
    """Return a field's losses, score and processor seconds as a row in Markdown."""
    report = read_json(variant / "field.report.json")
    losses = report["trained" if "trained" in report else "after_lbfgs"]
    settings = FieldSettings.model_validate(OBJECTIVE).model_dump()
    terms = ("language", "clustering", "instance", "part")
    objective = settings["ridge"] * losses["ridge"]
    objective += sum(settings[f"weight_{name}"] * losses[name] for name in terms)
    scores = read_scores([variant / "scores.csv"])
    given = scores[scores["protocol"].str.startswith(f"{LEVEL_GIVEN.name}@")]
    score = level_cells(given)["Avg"].text
    record = (variant / "benchmarks" / "field.jsonl").read_text(encoding="utf-8").splitlines()[-1]
    shown = (f"{value:.5f}" for value in (objective, losses["language"], losses["clustering"]))
    return f"| {variant.name} | {' | '.join(shown)} | {score} | {json.loads(record)['cpu_time']:.0f} |"


if __name__ == "__main__":
    main()
