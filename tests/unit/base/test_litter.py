"""Unfinished files tell who writes them, and go once the writer is dead."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hilsplat.base.artifacts import atomic_folder, atomic_path, work_folder, write_text
from hilsplat.base.processes import machine, remove_litter


def dead_pid() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_what_dead_processes_left_is_removed_and_nothing_else(tmp_path):
    dead = dead_pid()
    folder = tmp_path / "d/s"
    (folder / f".writing-{machine()}-{dead}-folder").mkdir(parents=True)
    (folder / f".writing-{machine()}-{dead}-folder" / f".writing-{machine()}-{dead}-x").touch()
    (folder / f".writing-{machine()}-{dead}-abc.npz").touch()
    kept = [
        folder / f".writing-{machine()}-{os.getpid()}-abc.npz",
        folder / f".writing-00000000-{dead}-abc.npz",
        folder / ".masks.lock",
        folder / "masks",
    ]
    for path in kept:
        path.touch()
    assert len(remove_litter(tmp_path)) == 2
    assert sorted(folder.iterdir()) == sorted(kept)
    assert remove_litter(tmp_path / "nowhere") == []


def test_every_name_that_fits_a_folder_can_be_written(tmp_path):
    for name in ("a" * 255, "b" * 251 + ".npz"):
        write_text(tmp_path / name, "text")
        assert (tmp_path / name).read_text() == "text"
    with atomic_folder(tmp_path / ("f" * 255)) as folder:
        (folder / "x").touch()
    assert (tmp_path / ("f" * 255) / "x").exists()


@pytest.mark.parametrize("writer", [atomic_path, atomic_folder, work_folder])
def test_nothing_is_left_after_an_error(tmp_path, writer):
    with pytest.raises(ZeroDivisionError), writer(tmp_path / "out") as temporary:
        assert temporary.exists()
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_the_former_folder_stays_until_the_new_one_is_whole(tmp_path):
    out = tmp_path / "out"
    for text in ("one", "two"):
        with atomic_folder(out) as folder:
            (folder / text).touch()
            assert not (out / text).exists()
    with pytest.raises(ZeroDivisionError), atomic_folder(out):
        raise ZeroDivisionError
    assert [path.name for path in Path(out).iterdir()] == ["two"]
