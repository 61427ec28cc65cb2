"""Files are whole or absent; digests and caches follow content."""

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from hilsplat.base import artifacts
from hilsplat.base.arrays import made
from hilsplat.base.errors import ArtifactError, DiskSpaceError


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    artifacts.write_text(path, "old")
    with pytest.raises(RuntimeError), artifacts.atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]
    with (
        pytest.raises(RuntimeError),  # the error of the block, though the file is gone
        artifacts.atomic_folder(tmp_path / "out") as folder,
        artifacts.atomic_path(folder / "b.txt") as temporary,
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
    artifacts.write_text(tmp_path / "out/a.txt", "text")
    with artifacts.atomic_folder(tmp_path / "out/new") as folder:
        artifacts.write_text(folder / "inner/b.txt", "text")
        for path in (tmp_path / "out/c.safetensors", folder / "d.safetensors"):
            with artifacts.atomic_path(path) as temporary:
                safetensors.numpy.save_file({"a": np.zeros(1)}, temporary)
    found = {path.name: path.stat().st_mode for path in (tmp_path / "out").rglob("*")}
    file, folder = ((tmp_path / name).stat().st_mode for name in ("file", "folder"))
    files = dict.fromkeys(("a.txt", "b.txt", "c.safetensors", "d.safetensors"), file)
    assert found == files | {"new": folder, "inner": folder}


@pytest.fixture
def flushed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths of the files and folders that are flushed to disk, at that time."""
    names: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda file: names.append(str(Path(f"/proc/self/fd/{file}").readlink())))
    return names


def test_a_file_is_flushed_before_it_replaces_the_former_one_and_its_folder_after_that(
    tmp_path: Path, flushed: list[str]
) -> None:
    artifacts.write_text(tmp_path / "a.txt", "text")
    file, folder = flushed
    assert artifacts.is_unfinished(Path(file)) and folder == str(tmp_path)


def test_the_files_of_a_folder_are_flushed_once_before_it_replaces_the_former_one(
    tmp_path: Path, flushed: list[str]
) -> None:
    with artifacts.atomic_folder(tmp_path / "out") as new:
        artifacts.write_text(new / "a.txt", "text")
        with artifacts.atomic_folder(new / "inner") as inner:
            artifacts.write_text(inner / "b.txt", "text")
            (inner / "c.txt").touch()
        assert flushed == []
    files = [str(new / name) for name in ("inner/b.txt", "inner/c.txt", "inner", "a.txt")]
    assert sorted(flushed[:4]) == sorted(files)
    assert flushed[4:] == [str(new), str(tmp_path)]


@pytest.mark.parametrize(("code", "is_raised"), [(errno.EINVAL, False), (errno.EIO, True)])
def test_only_file_systems_that_cannot_flush_are_excused(tmp_path, monkeypatch, code, is_raised) -> None:
    def fail(_: int) -> None:
        raise OSError(code, "flush")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="flush") if is_raised else nullcontext():
        artifacts.write_text(tmp_path / "a.txt", "text")
    assert (tmp_path / "a.txt").exists() != is_raised


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
        (RuntimeError("a library failed"), 0.5, True),
        (ChildProcessError("a library ended its process"), 0.5, True),
        (RuntimeError("a library failed"), 1, False),
        (ValueError("a fault of ours"), 0.5, False),
        (ArtifactError("an input is damaged: disk is full"), 0.5, False),
    ],
    ids=repr,
)
@pytest.mark.parametrize("writer", [artifacts.atomic_path, artifacts.atomic_folder, artifacts.work_folder])
def test_errors_on_a_full_disk_name_the_disk_and_the_fix(
    tmp_path, free_mib, writer, error, free, is_full
) -> None:
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
    with pytest.raises(DiskSpaceError, match=message), artifacts.atomic_folder(tmp_path / "out"):
        raise RuntimeError("a library failed")
    message = rf"no space left while writing view\.npz in {tmp_path}\n"
    with (
        pytest.raises(DiskSpaceError, match=message),
        artifacts.atomic_folder(tmp_path / "out") as folder,
        artifacts.atomic_folder(folder / "inner") as inner,
        artifacts.atomic_path(inner / "view.npz"),
    ):
        raise RuntimeError("a library failed")
    with (
        pytest.raises(OSError, match="broken") as raised,
        artifacts.atomic_path(tmp_path / "a.txt") as temporary,
    ):
        raise OSError(errno.EIO, "broken", str(temporary))
    assert raised.value.filename == str(tmp_path / "a.txt")


def test_too_little_space_is_refused_before_work_begins(tmp_path: Path, free_mib) -> None:
    free_mib(2)
    artifacts.require_free_space(tmp_path / "not" / "yet", 2.0)
    with pytest.raises(DiskSpaceError, match=rf"disk of {tmp_path}\n.*at least 3 MiB free\n.*2 MiB free"):
        artifacts.require_free_space(tmp_path / "not" / "yet", 3.0)


def test_npz_of_the_same_arrays_has_the_same_bytes(tmp_path: Path) -> None:
    arrays = {"a": np.arange(5), "b": np.ones((2, 2), np.float32)}
    artifacts.write_npz(tmp_path / "1.npz", **arrays)
    artifacts.write_npz(tmp_path / "2.npz", **arrays)
    assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "2.npz").read_bytes()
    back = artifacts.read_npz(tmp_path / "1.npz")
    assert sorted(back) == ["a", "b"]
    np.testing.assert_array_equal(back["b"], arrays["b"])


def test_a_file_that_changed_after_its_index_was_written_is_found(tmp_path: Path) -> None:
    with artifacts.atomic_folder(tmp_path / "out") as folder:
        artifacts.write_npy(folder / "a.npy", np.arange(3))
        artifacts.write_index(folder, {})
    assert artifacts.read_npy(artifacts.sealed(tmp_path / "out", "a.npy")).tolist() == [0, 1, 2]
    artifacts.write_npy(tmp_path / "out/a.npy", np.arange(4))
    with pytest.raises(ArtifactError, match=r"a\.npy was changed after it was written"):
        artifacts.sealed(tmp_path / "out", "a.npy")


@pytest.mark.parametrize(
    "write", [artifacts.write_npy, lambda path, array: artifacts.write_npz(path, a=array)]
)
def test_objects_are_never_pickled(tmp_path: Path, write) -> None:
    with pytest.raises(ValueError, match="allow_pickle=False"):
        write(tmp_path / "a", np.array([{}], dtype=object))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("save", "read"), [(np.save, artifacts.read_npy), (np.savez, artifacts.read_npz)], ids=["npy", "npz"]
)
def test_objects_are_never_unpickled(tmp_path: Path, save, read) -> None:
    path = tmp_path / "evil"
    with path.open("wb") as stream:
        save(stream, np.array([{}], dtype=object))
    with pytest.raises(ArtifactError, match=r"evil.* cannot be read: .*allow_pickle=False"):
        read(path)


def test_cache_computes_once_and_recovers_from_a_damaged_entry(tmp_path: Path) -> None:
    cache = artifacts.ViewCache(tmp_path)
    for hits in (0, 1):
        assert cache.get("key", lambda: {"x": np.array([1, 2])})["x"].tolist() == [1, 2]
        assert cache.hits == hits
    cache.path("key").write_bytes(b"broken")
    assert cache.get("key", lambda: {"x": np.array([3])})["x"].tolist() == [3]
    assert cache.hits == 1


@pytest.mark.parametrize("compressed", [True, False])
def test_entries_that_a_power_failure_cut_or_filled_with_zeros_are_computed_again(
    tmp_path: Path, flushed: list[str], compressed: bool
) -> None:
    cache = artifacts.ViewCache(tmp_path, compressed=compressed)
    arrays = {"x": np.arange(60.0), "none": np.zeros((0, 3)), "is": np.arange(100) % 3 == 0}
    cache.get("key", lambda: arrays)
    assert flushed == []
    path = cache.path("key")
    whole = path.read_bytes()
    size = len(whole)
    zeros = [(start, start + 16) for start in range(0, size, 5)]
    zeros += [(end, size) for end in range(size - 40, size)]
    cut = [whole[:end] for end in range(0, size, 9)]
    for damaged in [whole[:start] + bytes(end - start) + whole[end:] for start, end in zeros] + cut:
        path.write_bytes(damaged)
        found = cache.get("key", lambda: arrays)
        assert found.keys() == arrays.keys()
        assert all(np.array_equal(found[name], arrays[name]) for name in arrays)


def test_two_nodes_that_compute_one_view_leave_one_whole_entry(tmp_path: Path, monkeypatch) -> None:
    """The other node writes and ends while this one writes."""
    cache, other = artifacts.ViewCache(tmp_path), artifacts.ViewCache(tmp_path)
    key = artifacts.sha256_of_json({"image": "abc"})
    write = artifacts._write_zip

    def write_beside_the_other(path: Path, *arguments: Any, **options: bool) -> None:
        with artifacts.atomic_path(path) as temporary:
            temporary.write_bytes(b"half an ent")
            with monkeypatch.context() as node:
                node.setattr(artifacts, "_write_zip", write)
                node.setattr("hilsplat.base.processes.host_token", lambda: "0" * 8)
                other.get(key, lambda: {"x": np.arange(3)})
            write(temporary, *arguments, **options)

    monkeypatch.setattr(artifacts, "_write_zip", write_beside_the_other)
    mine = cache.get(key, lambda: {"x": np.arange(3)})
    np.testing.assert_array_equal(mine["x"], artifacts.read_npz(cache.path(key))["x"])
    assert [path for path in tmp_path.rglob("*.npz") if path.is_file()] == [cache.path(key)]


def test_an_entry_that_another_node_prunes_is_still_read(tmp_path: Path, monkeypatch) -> None:
    cache, key = artifacts.ViewCache(tmp_path), "abc"
    cache.get(key, lambda: {"x": np.arange(3)})
    read = artifacts.read_npz

    def read_and_prune(path: Path) -> dict[str, np.ndarray]:
        arrays = read(path)
        path.unlink()
        return arrays

    monkeypatch.setattr(artifacts, "read_npz", read_and_prune)
    assert cache.get(key, dict)["x"].tolist() == [0, 1, 2]


def test_a_second_writer_is_refused(tmp_path: Path) -> None:
    with (
        artifacts.output_lock(tmp_path / "out"),
        pytest.raises(ArtifactError, match="another process is writing"),
        artifacts.output_lock(tmp_path / "out"),
    ):
        pass


def test_digest_of_parts_depends_on_their_boundaries() -> None:
    assert artifacts.sha256_of_bytes(b"ab", b"c") != artifacts.sha256_of_bytes(b"a", b"bc")
    assert artifacts.sha256_of_json({"a": 1, "b": 2}) == artifacts.sha256_of_json({"b": 2, "a": 1})


def test_folder_digest_follows_names_and_bytes(tmp_path: Path) -> None:
    folder = tmp_path / "f"
    folder.mkdir()
    (folder / "a").write_bytes(b"1")
    first = artifacts.sha256_of_path(folder)
    with artifacts.work_folder(folder / "hidden") as unfinished:
        (unfinished / "c").write_bytes(b"2")
        assert artifacts.sha256_of_path(folder) == first
    (folder / "a").rename(folder / "b")
    assert artifacts.sha256_of_path(folder) != first


def test_arrays_of_another_version_are_recognised():
    @dataclass
    class Pair:
        left: np.ndarray
        right: np.ndarray
        name: str

    left, right = np.zeros(2), np.ones(1)
    with pytest.raises(ArtifactError, match=r"a different version(.|\n)*left, right(.|\n)*left, middle"):
        made(Pair, {"left": left, "middle": right}, {"name": "a"}, Path("old.npz"))
    assert made(Pair, {"left": left, "right": right}, {"name": "a"}, Path("new.npz")).name == "a"
