"""Killed writers leave artifacts whole, and the next clean-up removes unfinished files."""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from hilsplat.base import processes, removal
from hilsplat.base.artifacts import write_text
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import system_error

KILL = """
import ctypes, errno, os, shutil, signal, sys
from pathlib import Path
from hilsplat.base import artifacts, atomic, processes, removal

kind, folder = sys.argv[1], Path(sys.argv[2])
path = folder / "artifact"
TRACED = {artifacts.__file__, atomic.__file__, processes.__file__, removal.__file__, shutil.__file__}

def no_exchange(*arguments):
    ctypes.set_errno(errno.EINVAL)
    return -1

if "without exchange" in kind:
    removal._renameat2 = no_exchange

def write(text):
    if kind == "file":
        artifacts.write_text(path, text)
    else:
        with atomic.atomic_folder(path) as new:
            for name in "ab":
                artifacts.write_text(new / name, text)

def found():
    if not path.exists():
        return "nothing"
    texts = [path] if kind == "file" else sorted(path.iterdir())
    return "+".join(text.read_text() for text in texts)

def killed_before(line, action):
    child = os.fork()
    if child == 0:
        def trace(frame, event, argument):
            nonlocal line
            if frame.f_code.co_filename not in TRACED:
                return None
            if event == "line":
                line -= 1
                if line == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
            return trace
        sys.settrace(trace)
        action()
        os._exit(0)
    return os.waitpid(child, 0)[1] == signal.SIGKILL

line, is_killed = 0, True
while is_killed:
    line += 1
    if "old" not in found():
        write("old")
    if kind == "clean-up":
        former = folder / f".writing-{processes.host_token()}-01234567/.former"
        path.rename(folder / "aside")
        write("new")
        former.mkdir(parents=True)
        (former.parent / ".lock").touch()
        (folder / "aside").rename(former / "artifact")
        is_killed = killed_before(line, lambda: processes.remove_leftovers(folder))
        shutil.rmtree(path)  # by Snakemake, for instance
    else:
        is_killed = killed_before(line, lambda: write("new"))
    processes.remove_leftovers(folder)
    print(found(), *(name for name in os.listdir(folder) if name != "artifact"))
"""


def after_kills(kind: str, folder: Path) -> list[str]:
    """Return the artifact and leftover names after a kill before each line of the writer."""
    command = [sys.executable, "-c", KILL, kind, str(folder)]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()


@pytest.mark.parametrize("kind", ["file", "folder", "folder without exchange"])
def test_an_artifact_is_the_old_or_the_new_version_wherever_its_writer_is_killed(tmp_path, kind):
    versions = {"old", "new"} if kind == "file" else {"old+old", "new+new"}
    found = after_kills(kind, tmp_path)
    assert set(found) == versions
    assert found == sorted(found, reverse=True), "the new version never disappears again"


def test_an_old_version_is_never_partly_restored(tmp_path):
    """A clean-up is killed while it deletes a former version, and then the artifact is deleted."""
    assert set(after_kills("clean-up", tmp_path)) == {"old+old", "nothing"}


WRITER = """
import os, sys, time
os.getpid = lambda: int(sys.argv[2])  # the number in another process namespace
from hilsplat.base.atomic import atomic_folder, atomic_path
with {writer}(sys.argv[1]) as temporary:
    print(flush=True)
    time.sleep(60)
"""


@pytest.fixture(params=["atomic_path", "atomic_folder"])
def writers(tmp_path, request) -> Iterator[list[subprocess.Popen]]:
    """Writing processes that have the ids of a dead and of a live process here."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    script = WRITER.format(writer=request.param)
    running = []
    for pid in (dead.pid, os.getpid()):
        command = [sys.executable, "-c", script, str(tmp_path / f"scene/{pid}"), str(pid)]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE))
        running[-1].stdout.readline()
    yield running
    for writer in running:
        writer.kill()
        writer.wait()


def test_unfinished_files_are_kept_while_their_writer_lives_in_any_container(tmp_path, writers):
    assert processes.remove_leftovers(tmp_path) == []
    for left, clean_up in (
        (1, processes.remove_leftovers),
        (0, lambda folder: write_text(folder / "scene/next", "")),
    ):
        writers[left].send_signal(signal.SIGKILL)
        writers[left].wait()
        clean_up(tmp_path)
        assert len(list((tmp_path / "scene").glob(".*"))) == left


def test_only_folders_of_unfinished_files_of_this_host_are_removed(tmp_path):
    folder = tmp_path / "d/s"
    leftover = folder / f".writing-{processes.host_token()}-01234567"
    (leftover / f".writing-{processes.host_token()}-01234567").mkdir(parents=True)
    (leftover / ".lock").touch()
    of_user = folder / f".writing-{processes.host_token()}-89abcdef"  # without a lock
    kept = [folder / ".writing-00000000-01234567", folder / ".masks.lock", folder / "masks", of_user]
    for path in kept:
        path.mkdir()
    (of_user / "drawing.png").touch()
    (of_others := tmp_path / "of_others").mkdir()
    for name in (".lock", "drawing.png"):
        (of_others / name).touch()
    kept.append(folder / f".writing-{processes.host_token()}-fedcba98")
    kept[-1].symlink_to(of_others)
    (container := folder / ".writing-00000000-89abcdef").mkdir()  # of this machine, with another name
    (container / ".lock").write_text(processes.boot_id())
    assert sorted(processes.remove_leftovers(tmp_path)) == sorted([leftover, container])
    assert sorted(folder.iterdir()) == sorted(kept)
    assert (of_others / "drawing.png").exists()
    assert processes.remove_leftovers(tmp_path / "nowhere") == []


@pytest.mark.parametrize("is_lock_created", [True, False])
def test_a_writer_whose_folder_is_removed_before_it_is_locked_takes_another(
    tmp_path, monkeypatch, is_lock_created
):
    module, name = (processes, "lock") if is_lock_created else (Path, "open")
    function = getattr(module, name)

    def after_a_clean_up(*arguments):
        monkeypatch.undo()
        assert len(processes.remove_leftovers(tmp_path)) == 1
        return function(*arguments)

    monkeypatch.setattr(module, name, after_a_clean_up)
    write_text(tmp_path / "a", "text")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["text"]


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ESTALE, errno.EOPNOTSUPP])
def test_a_folder_that_cannot_be_locked_is_deleted_and_the_users_file_is_named(tmp_path, monkeypatch, number):
    def refuse(*arguments):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.raises(OSError, match=os.strerror(number)) as refusal:
        write_text(tmp_path / "a", "text")
    assert str(system_error(refusal.value)).startswith(f"{tmp_path / 'a'} cannot be")
    assert not list(tmp_path.iterdir())


def test_every_name_that_fits_a_folder_can_be_written(tmp_path):
    for name in ("a" * 255, "b" * 251 + ".npz"):
        write_text(tmp_path / name, "text")
        assert (tmp_path / name).read_text() == "text"
    with atomic_folder(tmp_path / ("f" * 255)) as folder:
        write_text(folder / ("x" * 255), "text")
    assert (tmp_path / ("f" * 255) / ("x" * 255)).exists()


def test_the_old_folder_is_restored_if_the_new_one_cannot_replace_it(tmp_path, monkeypatch):
    write_text(tmp_path / "out/former", "text")
    monkeypatch.setattr(removal, "_renameat2", None)
    rename = Path.rename

    def refuse(path: Path, target: Path) -> Path:
        if path.name == "new":
            raise OSError("a fault of the disk")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(OSError, match="a fault"), atomic_folder(tmp_path / "out") as folder:
        write_text(folder / "later", "text")
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "former"]


@pytest.mark.parametrize("can_exchange", [True, False])
def test_the_old_folder_remains_until_the_new_one_is_complete(tmp_path, monkeypatch, can_exchange):
    if not can_exchange:
        monkeypatch.setattr(removal, "_renameat2", None)
    out = tmp_path / "out"
    for text in ("one", "two"):
        with atomic_folder(out) as folder:
            (folder / text).touch()
            assert not (out / text).exists()
    with pytest.raises(ZeroDivisionError), atomic_folder(out):
        raise ZeroDivisionError
    assert [path.name for path in Path(out).iterdir()] == ["two"]
    assert list(tmp_path.iterdir()) == [out]
