"""A scene whose row names a PLY is not fitted; its report names the origin of the Gaussians."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import save_ply
from tests.unit.round_gaussians import round_gaussians
from tests.workflow.conftest import Project, copy_project

SCENE = "results/synthetic/tiny"


def three_gaussians(seed: int) -> Gaussians:
    """Three round Gaussians at random places."""
    plain = round_gaussians(np.random.default_rng(seed).normal(size=(3, 3)), log_scale=-2.0)
    return replace(plain, sh=np.ones((3, 4, 3), np.float32))


@pytest.fixture
def existing(project: Path, tmp_path: Path) -> Project:
    """A project whose tiny scene comes with three Gaussians."""
    copy = copy_project(project, tmp_path / "project", results=False)
    save_ply(copy.root / "their things" / "three.ply", three_gaussians(seed=0))
    sheet = copy.root / "config/scenes.tsv"
    lines = []
    for line in sheet.read_text().splitlines():
        cell = "gaussians" if line.startswith("dataset\t") else "-"
        if line.startswith("synthetic\ttiny\t"):
            cell = "their things/three.ply"
        lines.append(line if line.startswith("#") else f"{line}\t{cell}")
    sheet.write_text("\n".join(lines) + "\n")
    return copy


def test_brought_gaussians_take_the_place_of_a_fit(existing: Project) -> None:
    existing.snakemake("--keep-going", f"{SCENE}/gaussians.ply")
    report = json.loads((existing.root / SCENE / "gaussians/report.json").read_text())
    assert report["origin"]["kind"] == "imported"
    assert report["origin"]["file"] == "three.ply"
    assert report["gaussians"] == 3
    assert report["warnings"]  # three random Gaussians do not show the scene
    coordinates = json.loads((existing.root / SCENE / "gaussians.json").read_text())
    assert coordinates["ply"] == "gaussians.ply"
    provenance = json.loads((existing.root / f"{SCENE}/gaussians.ply.provenance.json").read_text())
    assert provenance["inputs"]["existing"]["path"].endswith("their things/three.ply")
    # other Gaussians rerun the stage
    save_ply(existing.root / "their things/three.ply", three_gaussians(seed=1))
    assert "rule gaussians:" in existing.snakemake("-n", f"{SCENE}/gaussians.ply").stdout


def test_a_lost_ply_stops_the_run_at_once(existing: Project) -> None:
    (existing.root / "their things/three.ply").unlink()
    result = existing.snakemake("-n", check=False)
    assert result.returncode != 0
    assert "column gaussians" in result.stdout + result.stderr
    assert "Traceback" not in result.stderr
