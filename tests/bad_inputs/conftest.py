"""A finished scene, of which each test gets a copy, and a fixture that runs commands in this process."""

import logging
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hilsplat.base.artifacts import visible_files
from hilsplat.base.errors import HilsplatError
from hilsplat.cli.main import main
from tests.conftest import PROJECT
from tests.unit.finished_desk import build_finished_desk


@pytest.fixture(scope="session")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with a complete scene."""
    project = build_finished_desk(tmp_path_factory.mktemp("desk"))
    for part in ("config", "models/sam-tiny", "models/clip-tiny"):
        shutil.copytree(PROJECT / part, project / part)
    return project


@pytest.fixture
def project(desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the project, set as the working directory."""
    copy = tmp_path / "project"
    shutil.copytree(desk, copy, ignore=shutil.ignore_patterns("sam-tiny", "clip-tiny"))
    for model in ("sam-tiny", "clip-tiny"):
        (copy / "models" / model).symlink_to(desk / "models" / model)
    monkeypatch.chdir(copy)
    return copy


@pytest.fixture
def told(capsys, caplog, monkeypatch) -> Callable[..., str]:
    """A function that runs a command or calls a function, which must refuse, and returns the message."""

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
    """Return the bytes of all files except hidden files and those in hidden folders, such as caches."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in visible_files(folder)}
