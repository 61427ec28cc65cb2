"""A finished scene that each test gets a copy of, and commands in this process."""

import logging
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hilsplat.base.errors import HilsplatError
from hilsplat.cli.main import main
from tests.conftest import PROJECT
from tests.unit.finished_desk import build_finished_desk


@pytest.fixture(scope="session")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with a scene, every stage of which ran."""
    project = build_finished_desk(tmp_path_factory.mktemp("desk"))
    for part in ("config", "models/sam-tiny", "models/clip-tiny"):
        shutil.copytree(PROJECT / part, project / part)
    return project


@pytest.fixture
def project(desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, and the place in which commands run."""
    copy = tmp_path / "project"
    shutil.copytree(desk, copy, ignore=shutil.ignore_patterns("sam-tiny", "clip-tiny"))
    for model in ("sam-tiny", "clip-tiny"):
        (copy / "models" / model).symlink_to(desk / "models" / model)
    monkeypatch.chdir(copy)
    return copy


@pytest.fixture
def told(capsys, caplog, monkeypatch) -> Callable[..., str]:
    """Run a command, or call a function, that must refuse; returns what it says to the person."""

    def run(command: tuple[str, ...] | Callable[[], object]) -> str:
        handlers = list(logging.getLogger().handlers)
        if callable(command):
            with pytest.raises(HilsplatError) as refusal:
                command()
            return str(refusal.value)
        monkeypatch.setattr(sys, "argv", ["hilsplat", *command])
        try:
            with pytest.raises(SystemExit) as ended:
                main()
        finally:
            logging.getLogger().handlers[:] = handlers
        assert ended.value.code not in (0, None)
        printed = capsys.readouterr()
        return printed.out + printed.err + caplog.text

    return run


def snapshot(folder: Path) -> dict[str, bytes]:
    """Bytes of all files that a person would miss: without logs, locks and caches."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".") and ".cache" not in path.parts
    }
