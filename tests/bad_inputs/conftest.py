"""Copies of a finished scene, and a fixture that runs commands in this process."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hilsplat.base.errors import HilsplatError
from hilsplat.base.lineage import visible_files
from hilsplat.cli.main import main
from tests.conftest import PROJECT


@pytest.fixture
def project(desk_project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the finished desk with the shipped configuration and models, set as the working directory."""
    copy = Path(shutil.copytree(desk_project, tmp_path / "project"))
    shutil.copytree(PROJECT / "config", copy / "config")
    for model in ("sam-tiny", "clip-tiny"):
        (copy / "models" / model).symlink_to(PROJECT / "models" / model)
    monkeypatch.chdir(copy)
    return copy


@pytest.fixture
def told(capsys, caplog, monkeypatch) -> Callable[..., str]:
    """A function that runs a command or calls a function, which must refuse, and returns the message."""

    def run(command: tuple[str, ...] | Callable[[], object]) -> str:
        if callable(command):
            with pytest.raises(HilsplatError) as refusal:
                command()
            return str(refusal.value)
        monkeypatch.setattr(sys, "argv", ["hilsplat", *command])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code not in (0, None)
        printed = capsys.readouterr()
        return printed.out + printed.err + caplog.text

    return run


def snapshot(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files except hidden files and those in hidden folders, such as caches."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in visible_files(folder)}
