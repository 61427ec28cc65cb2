"""The finished tiny scene, queried as by a user: from other folders, and after the results moved."""

import json
import shutil
import sys
from pathlib import Path

from tests.workflow.conftest import SCENE, Project, copy_project


def hilsplat(project: Project, folder: Path, *words: str) -> str:
    """Output of the copy's own command, run in a folder."""
    command = "from hilsplat.cli.main import main; main()"
    there = Project(folder)
    result = there.run(sys.executable, "-c", command, *words, PYTHONPATH=str(project.root))
    return result.stdout


def test_query_and_export_work_from_another_folder(finished: Project, tmp_path: Path) -> None:
    printed = hilsplat(finished, tmp_path, "query", str(finished.root / SCENE), "mug", "--out", "answer")
    assert "to 'mug' in synthetic/tiny" in printed
    assert (tmp_path / "answer/panel.png").stat().st_size > 20_000
    assert "whole" in hilsplat(finished, tmp_path, "export", str(finished.root / SCENE), "--out", "tree")
    assert {path.name for path in (tmp_path / "tree").iterdir()} == {"tree.json", "tree.ply", "tree.png"}


def test_moved_results_open_with_the_clip_of_the_checkout(finished: Project, tmp_path: Path) -> None:
    shutil.copytree(finished.root / "results/synthetic", tmp_path / "archive/synthetic")
    printed = hilsplat(
        finished, tmp_path, "query", "synthetic/tiny", "unicorn", "--results", "archive", "--out", "answer"
    )
    before = hilsplat(
        finished, finished.root, "query", "synthetic/tiny", "unicorn", "--out", str(tmp_path / "b")
    )
    assert printed.splitlines()[:-1] == before.splitlines()[:-1]


def test_another_clip_is_refused(finished: Project, tmp_path: Path) -> None:
    copy = copy_project(finished.root, tmp_path / "project", results=True)
    card = copy.root / "models/clip-tiny/config.json"
    card.write_text(card.read_text() + "\n")
    command = "import hilsplat; hilsplat.open('results/synthetic/tiny')"
    refused = copy.run(sys.executable, "-c", command, check=False)
    assert refused.returncode != 0
    assert (
        "the CLIP that embedded the masks in results/synthetic/tiny/default/clip was not found"
        in refused.stderr
    )


def test_langsplat_files_go_out_and_come_back(finished: Project, tmp_path: Path) -> None:
    default = finished.root / SCENE / "paper"  # its vectors are of every mask
    places = ("--masks", str(default.with_name("default") / "masks"), "--clip", str(default / "clip"))
    hilsplat(finished, tmp_path, "langsplat", "write", *places, "--out", "language_features")
    model = json.dumps({"model": str(finished.root / "models/clip-tiny")})
    taken = ("--scene", str(finished.root / SCENE / "scene"), "--features", "language_features")
    hilsplat(finished, tmp_path, "masks", *taken, "--out", "masks")
    hilsplat(finished, tmp_path, "clip", *taken, "--masks", "masks", "--settings", model, "--out", "clip")
    index = json.loads((tmp_path / "clip/index.json").read_text())
    before = json.loads((default / "clip/index.json").read_text())
    assert index["model_sha256"] == before["model_sha256"]
    assert index["views"].keys() == before["views"].keys()
