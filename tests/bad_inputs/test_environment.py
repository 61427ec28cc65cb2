"""Commands in an unusable environment: full output, shell limits, a deleted working directory."""

import errno
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
