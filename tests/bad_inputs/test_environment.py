"""Commands in an unusable environment: full output, shell limits, a deleted working directory."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hilsplat.base.errors import ImageError, ModelError, system_error
from hilsplat.base.images import read_image
from tests.bad_inputs.test_bad_inputs import CONTRIBUTE, MASKS

QUERY = "query photos/desk mug --out answers"
STAGE = " ".join(CONTRIBUTE)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (f"{QUERY} > /dev/full", "standard output or an open file cannot be written: the disk is full"),
        ("--help > /dev/full", "standard output"),
        (f"ulimit -f 1; {QUERY}", "exceed the size limit of this shell (ulimit -f)"),
        (f"ulimit -f 1; {STAGE}", "exceed the size limit of this shell (ulimit -f)"),
        (f"ulimit -v 300000; {QUERY}", "not enough memory"),
        (f"mkdir gone; cd gone; rmdir ../gone; {QUERY}", "the working directory was deleted"),
        ("query photos/desk mug --out /proc/x", "/proc/x is missing or cannot be created"),
        ("export photos/desk --out /proc/x", "/proc/x is missing or cannot be created"),
        (f"--log config/config.yaml coverage-tree --masks {MASKS} --out new", "is not a .log file"),
        ("run -- --cores 0", "with --cores 0, no job can start"),
        ("run -- --directory elsewhere", "hilsplat run works in the current folder"),
        ("run -- --config 'only=[1'", "--config is not valid YAML"),
        ("run -- -n --config results=config/config.yaml groups=[ci]", "config.yaml is not a folder"),
    ],
)
def test_what_surrounds_a_command(line: str, words: str, project: Path):
    *before, command = line.split("; ")
    script = "; ".join([*before, f"{sys.executable} -m hilsplat {command}"])
    ended = subprocess.run(script, shell=True, cwd=project, capture_output=True, text=True, timeout=300)
    said = ended.stdout + ended.stderr
    assert ended.returncode not in (0, None)
    assert words in said
    assert "Traceback" not in said
    assert not list(project.rglob(".writing-*"))


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RuntimeError("can't start new thread"), "too few threads"),
        (OSError(errno.EAGAIN, "Resource temporarily unavailable", "git"), "git needs more processes than"),
        (OSError(errno.ESTALE, "Stale file handle", "a.png"), "a.png cannot be read or written: the network"),
        (OSError(errno.ETIMEDOUT, "Connection timed out", "a.png"), "a.png cannot be read or written"),
    ],
)
def test_errors_of_the_machine_are_no_traceback(error: Exception, words: str):
    assert words in str(system_error(error))


def test_an_image_that_the_machine_cannot_read_is_not_called_damaged(tmp_path: Path, monkeypatch):
    def refuse(*arguments, **options):
        raise OSError(errno.EIO, "Input/output error")

    (tmp_path / "a.png").write_bytes(bytes(100))
    monkeypatch.setattr("PIL.Image.open", refuse)
    with pytest.raises(ImageError, match="replace it with an intact copy") as refusal:
        read_image(tmp_path / "a.png")
    repeated = ModelError("a.png cannot be read: of a model")
    repeated.__cause__ = refusal.value
    for error in (refusal.value, repeated):
        text = str(system_error(error))
        assert "a.png cannot be read" in text and "the file may be intact" in text and "replace" not in text


def test_more_threads_than_cores_cost_nothing(project: Path):
    script = f"{sys.executable} -m hilsplat {QUERY} --threads 100000"
    assert subprocess.run(script, shell=True, cwd=project, timeout=60, check=True).returncode == 0


REGISTRY = """
from hilsplat.stage import PathOut, Registry
PIPELINE = Registry()
@PIPELINE.stage()
def masks(out: PathOut) -> None: ...
"""
SECTION = "from hilsplat.settings import Section\nclass NAME(Section): ..."


@pytest.mark.parametrize(
    ("group", "point", "code", "words"),
    [
        ("stages", "x = mine:NAME", "import no_such", "x = mine:NAME cannot be imported: No module named"),
        ("settings", "x = mine:NAME", "", "x = mine:NAME cannot be imported: module 'mine' has no"),
        ("commands", "x = mine:NAME", "NAME = 1", "x = mine:NAME has the wrong type"),
        ("settings", "masks = mine:NAME", "", "'masks' is a name in both mine and hilsplat"),
        ("settings", "results = mine:NAME", SECTION, "'results' is a name in both mine and hilsplat"),
        ("datasets", "replica = mine:NAME", "", "'replica' is a name in both mine and hilsplat"),
        ("methods", "saga = mine:NAME", "", "'saga' is a name in both mine and hilsplat"),
        ("generators", "world = mine:NAME", "", "'world' is a name in both"),  # packages, in either order
        ("stages", "x = mine:PIPELINE", REGISTRY, "'masks' is a name in both hilsplat and x"),
        ("commands", "query = mine:NAME", "import typer\nNAME = typer.Typer()", "commands are named 'query'"),
    ],
)
def test_a_broken_plugin_and_one_that_takes_a_name_are_named(tmp_path: Path, group, point, code, words):
    (tmp_path / "mine.py").write_text(code)
    (tmp_path / "mine-1.0.dist-info").mkdir()
    (tmp_path / "mine-1.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (tmp_path / "mine-1.0.dist-info/entry_points.txt").write_text(f"[hilsplat.{group}]\n{point}\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ["PYTHONPATH"]])}
    command = [sys.executable, "-m", "hilsplat", "settings"]
    ended = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 1 and "Traceback" not in ended.stderr
    assert words in ended.stderr and f"hilsplat.{group}" in ended.stderr
