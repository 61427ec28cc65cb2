"""The finished tiny scene, queried as by a user: from other folders, and after the results moved."""

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
