"""Arrays keep their bytes and are never pickled; changed files and files of other versions are found."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base import artifacts
from hilsplat.base.arrays import build_checked
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import ArtifactError


def test_npz_of_the_same_arrays_has_the_same_bytes(tmp_path: Path) -> None:
    arrays = {"a": np.arange(5), "b": np.ones((2, 2), np.float32)}
    artifacts.write_npz(tmp_path / "1.npz", **arrays)
    artifacts.write_npz(tmp_path / "2.npz", **arrays)
    assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "2.npz").read_bytes()
    back = artifacts.read_npz(tmp_path / "1.npz")
    assert sorted(back) == ["a", "b"]
    np.testing.assert_array_equal(back["b"], arrays["b"])


def test_a_file_that_changed_after_its_index_was_written_is_found(tmp_path: Path) -> None:
    with atomic_folder(tmp_path / "out") as folder:
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


def test_arrays_of_another_version_are_recognised():
    @dataclass
    class Pair:
        left: np.ndarray
        right: np.ndarray
        name: str

    left, right = np.zeros(2), np.ones(1)
    with pytest.raises(ArtifactError, match=r"a different version(.|\n)*left, right(.|\n)*left, middle"):
        build_checked(Pair, {"left": left, "middle": right}, {"name": "a"}, Path("old.npz"))
    assert build_checked(Pair, {"left": left, "right": right}, {"name": "a"}, Path("new.npz")).name == "a"
