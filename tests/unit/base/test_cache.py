"""The caches: finished views, their size, the entries that are deleted, and files of users, which are not."""

import os
import re
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from hilsplat.base.artifacts import read_npz, write_arrays
from hilsplat.base.atomic import atomic_path
from hilsplat.base.cache import CACHES, ViewCache, prune_cache, remembered, size_table
from hilsplat.base.errors import HilsplatError
from hilsplat.base.lineage import sha256_of_json
from hilsplat.base.processes import host_token
from hilsplat.base.removal import tag
from tests.conftest import PROJECT

MIB = 2**20


@pytest.fixture
def cache(tmp_path) -> Path:
    """Entries of 1 MiB: masks unused for 0 to 3 days, a CLIP entry for 9; other files for 99 days."""
    for place, days in (("masks", 0), ("masks", 1), ("masks", 2), ("masks", 3), ("clip", 9), ("models", 99)):
        path = tmp_path / place / f"0{days % 10}" / f"{days:064}.npz"
        tag(tmp_path / place)
        path.parent.mkdir(parents=True)
        path.write_bytes(b"x" * MIB)
        used = time.time() - days * 86400 - 60
        os.utime(path, (used, used))
    unfinished = tmp_path / "masks/.writing-00000000-01234567/new.npz"
    unfinished.parent.mkdir()
    unfinished.write_bytes(b"x")
    (tmp_path / "digests.json").write_bytes(b"x" * MIB)
    return tmp_path


def left(cache: Path) -> list[str]:
    return sorted(path.relative_to(cache).as_posix() for path in cache.rglob("*.npz"))


@pytest.mark.parametrize(("problem", "examined"), [("", 1), ("the build was killed", 2)])
def test_a_problem_of_this_machine_is_examined_again_after_an_hour(tmp_path, monkeypatch, problem, examined):
    monkeypatch.setattr("hilsplat.base.cache._folder", lambda kind: tmp_path / kind)
    times = []

    def examine() -> str:
        times.append(1)
        return problem

    for age_s in (0, 60, 3660, 0):
        assert remembered("cuda", "build", examine) == problem
        (result,) = (tmp_path / "cuda").iterdir()
        os.utime(result, (time.time() - age_s,) * 2)
    assert len(times) == examined


def test_the_table_names_each_cache(cache):
    lines = size_table(cache).splitlines()
    assert [line.split() for line in lines[1:]] == [
        ["clip", "2", "files", "1.0", "MiB"],
        ["digests.json", "1", "files", "1.0", "MiB"],
        ["masks", "5", "files", "4.0", "MiB"],
        ["models", "2", "files", "1.0", "MiB"],
        ["all", "7.0", "MiB"],
    ]


def test_only_old_view_entries_are_deleted(cache, tmp_path):
    assert prune_cache(tmp_path / "nowhere", [], days=0.0) == (0, 0)
    assert prune_cache(cache, [], days=2.0) == (3, 3.0)
    assert left(cache) == [
        "masks/.writing-00000000-01234567/new.npz",
        f"masks/00/{0:064}.npz",
        f"masks/01/{1:064}.npz",
        f"models/09/{99:064}.npz",
    ]


def test_every_cache_can_be_pruned(tmp_path):
    sources = [path.read_text() for path in (PROJECT / "hilsplat").rglob("*.py")]
    names = {name for text in sources for name in re.findall(r'ViewCache\(.*? / "(\w+)"', text)}
    assert names | {"gaussians"} == {*CACHES}
    for name in names:
        ViewCache(tmp_path / name).put("0" * 64, {"x": np.zeros(1)})
    assert prune_cache(tmp_path, days=0.0)[0] == len(names)


def test_an_unknown_cache_is_refused(cache):
    with pytest.raises(HilsplatError, match=r"models\n.*gaussians, masks, contributions, clip, texts, int8"):
        prune_cache(cache, ["masks", "models"], days=0.0)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"stages": [], "max_mib": 0.0}, {"today", "yesterday", "old"}),
        ({"stages": [], "days": 5.0}, {"today", "yesterday"}),
        ({"stages": ["gaussians"], "days": 0.0}, {"today"}),
        ({"stages": ["gaussians"], "max_mib": 2.0}, {"today", "yesterday"}),
        ({"stages": ["gaussians"], "max_mib": 0.0}, {"today"}),
        ({"stages": ["masks"], "days": 0.0}, {"today", "yesterday", "old"}),
    ],
)
def test_checkpoints_are_pruned_unless_their_fit_may_still_run(cache, options, expected):
    tag(cache / "gaussians")
    names = {f"{23:016}": "today", f"{25:016}": "yesterday", f"{240:016}": "old"}
    for name, hours in zip(names, (23, 25, 240), strict=True):
        path = cache / f"gaussians/{name}.npz"
        path.write_bytes(b"x" * MIB)
        written = time.time() - hours * 3600
        os.utime(path, (written, written))
    prune_cache(cache, options.pop("stages"), **options)
    assert {names[path.stem] for path in (cache / "gaussians").glob("*.npz")} == expected


def test_without_a_limit_only_unfinished_files_of_dead_jobs_are_deleted(tmp_path_factory, cache):
    results = tmp_path_factory.mktemp("project") / "results"
    leftover = results / f"photos/desk/.writing-{host_token()}-01234567"
    leftover.mkdir(parents=True)
    shutil.copytree(cache, results / ".cache")
    assert prune_cache(results / ".cache", []) == (0, 0)
    assert not leftover.exists()
    assert left(results / ".cache") == left(cache)


def test_files_in_folders_named_like_a_cache_are_kept(cache, tmp_path_factory):
    """Drawings, videos, a scene's own masks, and files in a cache that do not have the names of entries."""
    folder = tmp_path_factory.mktemp("holiday")
    shutil.copytree(cache / "masks", folder / "masks")
    (folder / "masks/CACHEDIR.TAG").unlink()
    for name in ("clip/film.mp4", "gaussians/0123456789abcdef.npz", "contributions/me.txt"):
        (folder / name).parent.mkdir()
        (folder / name).touch()
    own = ["00/drawing.png", "a.npz", "00/a.npz", f"00/{1:064}.npy", f"x/{1:064}.npz", f"00/x/{1:064}.npz"]
    for name in own:
        (cache / "masks" / name).parent.mkdir(exist_ok=True)
        (cache / "masks" / name).touch()
    before = sorted(folder.rglob("*"))
    assert prune_cache(folder, [], days=0.0, max_mib=0.0) == (0, 0)
    assert sorted(folder.rglob("*")) == before
    assert prune_cache(cache, [], days=0.0, max_mib=0.0) == (5, 5.0)
    assert all((cache / "masks" / name).exists() for name in own)


def test_commands_that_prune_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    tag(tmp_path / "masks")
    for number in range(400):
        path = tmp_path / f"masks/{number % 256:02x}/{number:064}.npz"
        path.parent.mkdir(exist_ok=True)
        path.touch()

    def prune(_: int) -> str:
        prune_cache(tmp_path, [], days=0.0)
        return size_table(tmp_path)

    with ThreadPoolExecutor(8) as pool:
        assert len(list(pool.map(prune, range(8)))) == 8
    assert left(tmp_path) == []


def test_cache_computes_once_and_recovers_from_a_damaged_entry(tmp_path: Path) -> None:
    cache = ViewCache(tmp_path)
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
    cache = ViewCache(tmp_path, compressed=compressed)
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
    cache, other = ViewCache(tmp_path), ViewCache(tmp_path)
    key = sha256_of_json({"image": "abc"})
    write = write_arrays

    def write_beside_the_other(path: Path, *arguments: Any, **options: bool) -> None:
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"half an ent")
            with monkeypatch.context() as node:
                node.setattr("hilsplat.base.cache.write_arrays", write)
                node.setattr("hilsplat.base.processes.host_token", lambda: "0" * 8)
                other.get(key, lambda: {"x": np.arange(3)})
            write(temporary, *arguments, **options)

    monkeypatch.setattr("hilsplat.base.cache.write_arrays", write_beside_the_other)
    mine = cache.get(key, lambda: {"x": np.arange(3)})
    np.testing.assert_array_equal(mine["x"], read_npz(cache.path(key))["x"])
    assert [path for path in tmp_path.rglob("*.npz") if path.is_file()] == [cache.path(key)]


def test_an_entry_that_another_node_prunes_is_still_read(tmp_path: Path, monkeypatch) -> None:
    cache, key = ViewCache(tmp_path), "abc"
    cache.get(key, lambda: {"x": np.arange(3)})
    read = read_npz

    def read_and_prune(path: Path) -> dict[str, np.ndarray]:
        arrays = read(path)
        path.unlink()
        return arrays

    monkeypatch.setattr("hilsplat.base.cache.read_npz", read_and_prune)
    assert cache.get(key, dict)["x"].tolist() == [0, 1, 2]


def test_a_user_without_a_home_has_a_cache_among_the_temporary_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("platformdirs.user_cache_path", Mock(side_effect=RuntimeError("no home")))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    examine = Mock(return_value="fast")
    assert [remembered("speed", "key", examine) for _ in range(2)] == ["fast", "fast"]
    examine.assert_called_once()
    assert [path.name for path in tmp_path.iterdir()] == ["temporary"]
