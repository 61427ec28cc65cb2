"""A scene whose row names a PLY is not fitted; its report names the origin of the Gaussians."""

import json
from dataclasses import replace

import numpy as np

from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import save_ply
from tests.unit.round_gaussians import round_gaussians
from tests.workflow.conftest import Project

SCENE = "results/synthetic/tiny"


def three_gaussians(seed: int) -> Gaussians:
    """Three round Gaussians at random places."""
    plain = round_gaussians(np.random.default_rng(seed).normal(size=(3, 3)), log_scale=-2.0)
    return replace(plain, sh=np.ones((3, 4, 3), np.float32))


def test_your_own_gaussians_replace_the_fit(plain: Project) -> None:
    save_ply(plain.root / "their things/three.ply", three_gaussians(seed=0))
    sheet = plain.root / "config/scenes.tsv"
    lines = []
    for line in sheet.read_text().splitlines():
        cell = "gaussians" if line.startswith("dataset\t") else "-"
        if line.startswith("synthetic\ttiny\t"):
            cell = "their things/three.ply"
        lines.append(line if line.startswith("#") else f"{line}\t{cell}")
    sheet.write_text("\n".join(lines) + "\n")
    plain.snakemake("--keep-going", f"{SCENE}/gaussians.ply")
    report = json.loads((plain.root / SCENE / "gaussians/report.json").read_text())
    assert report["origin"]["kind"] == "imported"
    assert report["origin"]["file"] == "three.ply"
    assert report["gaussians"] == 3
    assert report["warnings"]  # three random Gaussians do not show the scene
    coordinates = json.loads((plain.root / SCENE / "gaussians.json").read_text())
    assert coordinates["ply"] == "gaussians.ply"
    provenance = json.loads((plain.root / f"{SCENE}/gaussians.ply.provenance.json").read_text())
    assert provenance["inputs"]["existing"]["path"].endswith("their things/three.ply")
    # other Gaussians rerun the stage
    save_ply(plain.root / "their things/three.ply", three_gaussians(seed=1))
    assert "rule gaussians:" in plain.snakemake("-n", f"{SCENE}/gaussians.ply").stdout
