"""The finished desk with named nodes."""

import shutil
from pathlib import Path

import pytest

from hilsplat.cli.main import app
from tests.unit.finished_desk import SCENE


@pytest.fixture(scope="session")
def named_desk(desk_project, tmp_path_factory) -> Path:
    """A copy of the finished desk whose nodes are named by the words that its CLIP knows."""
    project = shutil.copytree(desk_project, tmp_path_factory.mktemp("named") / "project")
    words = "[things]\nmug, book\n[parts]\nhandle, rim\n"
    (project / "models/colours/vocabulary.txt").write_text(words)
    default = SCENE / "default"
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(project)
        parts = ("--semantic-tree", str(default / "semantic_tree"), "--clip", str(default / "clip"))
        app(["names", *parts, "--out", str(default / "names")], standalone_mode=False)
    return project / SCENE
