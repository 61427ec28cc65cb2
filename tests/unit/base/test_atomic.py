"""Files and folders are whole or absent, with other files' permissions; full disks; locks of outputs."""

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import safetensors.numpy

from hilsplat.base.artifacts import write_text
from hilsplat.base.atomic import atomic_folder, atomic_path, output_lock, require_free_space, work_folder
from hilsplat.base.errors import ArtifactError, DiskSpaceError
from hilsplat.base.removal import is_unfinished


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]
    with (
        pytest.raises(RuntimeError),  # the error of the block, though the file is gone
        atomic_folder(tmp_path / "out") as folder,
        atomic_path(folder / "b.txt") as temporary,
    ):
        temporary.unlink()
        raise RuntimeError


@pytest.fixture(params=[0o022, 0o077, 0o002], ids=oct)
def umask(request) -> Iterator[None]:
    """Permissions that new files and folders do not get."""
    before = os.umask(request.param)
    yield
    os.umask(before)


@pytest.mark.usefixtures("umask")
def test_outputs_have_the_permissions_of_other_new_files(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    write_text(tmp_path / "out/a.txt", "text")
    with atomic_folder(tmp_path / "out/new") as folder:
        write_text(folder / "inner/b.txt", "text")
        for path in (tmp_path / "out/c.safetensors", folder / "d.safetensors"):
            with atomic_path(path) as temporary:
                safetensors.numpy.save_file({"a": np.zeros(1)}, temporary)
    found = {path.name: path.stat().st_mode for path in (tmp_path / "out").rglob("*")}
    file, folder = ((tmp_path / name).stat().st_mode for name in ("file", "folder"))
    files = dict.fromkeys(("a.txt", "b.txt", "c.safetensors", "d.safetensors"), file)
    assert found == files | {"new": folder, "inner": folder}
    for mode in (0o600, 0o664):  # of a file that a user shares or hides
        (tmp_path / "out/a.txt").chmod(mode)
        write_text(tmp_path / "out/a.txt", "other text")
        assert (tmp_path / "out/a.txt").stat().st_mode & 0o777 == mode


def test_file_systems_without_modes_can_be_written(tmp_path: Path, monkeypatch) -> None:
    def refuse(*arguments, **options) -> None:
        raise PermissionError(errno.EPERM, "chmod")

    monkeypatch.setattr(os, "chmod", refuse)
    write_text(tmp_path / "a.txt", "text")
    write_text(tmp_path / "a.txt", "other text")
    assert (tmp_path / "a.txt").read_text() == "other text"


def test_a_file_is_flushed_before_it_replaces_the_former_one_and_its_folder_after_that(
    tmp_path: Path, flushed: list[str]
) -> None:
    write_text(tmp_path / "a.txt", "text")
    file, folder = flushed
    assert is_unfinished(Path(file)) and folder == str(tmp_path)


def test_the_files_of_a_folder_are_flushed_once_before_it_replaces_the_former_one(
    tmp_path: Path, flushed: list[str]
) -> None:
    with atomic_folder(tmp_path / "out") as new:
        write_text(new / "a.txt", "text")
        with atomic_folder(new / "inner") as inner:
            write_text(inner / "b.txt", "text")
            (inner / "c.txt").touch()
        assert flushed == []
    files = [str(new / name) for name in ("inner/b.txt", "inner/c.txt", "inner", "a.txt")]
    assert sorted(flushed[:4]) == sorted(files)
    assert flushed[4:] == [str(new), str(tmp_path)]


@pytest.mark.parametrize(
    ("code", "is_raised"), [(errno.EINVAL, False), (errno.EOPNOTSUPP, False), (errno.EIO, True)]
)
def test_only_file_systems_that_cannot_flush_are_excused(tmp_path, monkeypatch, code, is_raised) -> None:
    def fail(_: int) -> None:
        raise OSError(code, "flush")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="flush") if is_raised else nullcontext():
        write_text(tmp_path / "a.txt", "text")
    assert (tmp_path / "a.txt").exists() != is_raised


@pytest.mark.parametrize("writer", [atomic_path, atomic_folder])
def test_a_replaced_file_is_no_error_if_only_its_folder_cannot_be_flushed(
    tmp_path, monkeypatch, caplog, writer
) -> None:
    def fail(descriptor: int) -> None:
        if os.path.samestat(os.fstat(descriptor), tmp_path.stat()):
            raise OSError(errno.EIO, "flush")

    monkeypatch.setattr(os, "fsync", fail)
    with writer(tmp_path / "a.txt"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert "a.txt was written, but a power failure may undo this: flush" in caplog.text


@pytest.fixture
def free_mib(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """A function that sets the free space on a disk of 8 MiB."""

    def set_free(mib: float) -> None:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=2**23, free=mib * 2**20))

    return set_free


@pytest.mark.parametrize(
    ("error", "free", "is_full"),
    [
        (OSError(errno.ENOSPC, "full"), 5, True),
        (OSError(errno.EDQUOT, "full"), 5, True),
        (OSError(errno.EACCES, "locked"), 0.5, False),
        (Exception("SQLite: database or disk is full"), 5, True),
        (OSError("4326 requested and 0 written"), 5, True),  # NumPy
        (RuntimeError("a library failed"), 0.5, True),
        (ChildProcessError("a library ended its process"), 0.5, True),
        (RuntimeError("a library failed"), 1, False),
        (ValueError("a fault of ours"), 0.5, False),
        (ArtifactError("an input is damaged: disk is full"), 0.5, False),
    ],
    ids=repr,
)
@pytest.mark.parametrize("writer", [atomic_path, atomic_folder, work_folder])
def test_errors_on_a_full_disk_name_the_disk_and_the_fix(tmp_path, free_mib, writer, error, free, is_full):
    free_mib(free)
    with pytest.raises(DiskSpaceError if is_full else type(error)) as raised, writer(tmp_path / "new/a.txt"):
        raise error
    if is_full:
        place, found, fix = str(raised.value).splitlines()
        assert place == f"no space left while writing a.txt in {tmp_path / 'new'}"
        assert f"{free:.1f} MiB free of 8 MiB on that disk" in found
        assert f"free up space on the disk of {tmp_path / 'new'}" in fix
    else:
        assert raised.value is error
    assert list((tmp_path / "new").iterdir()) == []


def test_errors_inside_a_new_folder_name_the_final_path(tmp_path: Path, free_mib) -> None:
    free_mib(0.5)
    message = rf"no space left while writing out in {tmp_path}\n"
    with pytest.raises(DiskSpaceError, match=message), atomic_folder(tmp_path / "out"):
        raise RuntimeError("a library failed")
    message = rf"no space left while writing view\.npz in {tmp_path}\n"
    with (
        pytest.raises(DiskSpaceError, match=message),
        atomic_folder(tmp_path / "out") as folder,
        atomic_folder(folder / "inner") as inner,
        atomic_path(inner / "view.npz"),
    ):
        raise RuntimeError("a library failed")
    with pytest.raises(OSError, match="broken") as raised, atomic_path(tmp_path / "a.txt") as temporary:
        raise OSError(errno.EIO, "broken", str(temporary))
    assert raised.value.filename == str(tmp_path / "a.txt")
    free_mib(5)
    with pytest.raises(OSError, match="Too many open files") as raised, atomic_path(tmp_path / "a.txt"):
        raise RuntimeError("Too many open files (os error 24)")  # safetensors
    assert (raised.value.errno, raised.value.filename) == (errno.EMFILE, str(tmp_path / "a.txt"))
    with pytest.raises(OSError, match="broken") as raised, atomic_path(tmp_path / "a.txt"):
        raise OSError(errno.EIO, "broken")
    assert raised.value.filename == f"{tmp_path / 'a.txt'}, or a file that it is made from,"


def test_too_little_space_is_refused_before_work_begins(tmp_path: Path, free_mib) -> None:
    free_mib(2)
    require_free_space(tmp_path / "not" / "yet", 2.0)
    with pytest.raises(DiskSpaceError, match=rf"disk of {tmp_path}\n.*at least 3 MiB free\n.*2 MiB free"):
        require_free_space(tmp_path / "not" / "yet", 3.0)


def test_a_second_writer_is_refused(tmp_path: Path) -> None:
    with (
        output_lock(tmp_path / "out"),
        pytest.raises(ArtifactError, match="another process is writing"),
        output_lock(tmp_path / "out"),
    ):
        pass
