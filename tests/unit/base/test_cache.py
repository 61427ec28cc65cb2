"""The caches of finished views: their size, and what is deleted first."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hilsplat.base.cache import prune_cache, size_table
from hilsplat.base.errors import HilsplatError
from hilsplat.base.processes import machine

MIB = 2**20


@pytest.fixture
def cache(tmp_path) -> Path:
    """Entries of 1 MiB: masks unused for 0, 1, 2 and 3 days, one of clip for 9, and a training state."""
    for place, days in (("masks", 0), ("masks", 1), ("masks", 2), ("masks", 3), ("clip", 9), ("models", 99)):
        path = tmp_path / place / f"{days}" / f"{days}.npz"
        path.parent.mkdir(parents=True)
        path.write_bytes(b"x" * MIB)
        used = time.time() - days * 86400 - 60
        os.utime(path, (used, used))
    (tmp_path / "masks" / ".half-written.npz").write_bytes(b"x")
    return tmp_path


def left(cache: Path) -> list[str]:
    return sorted(path.relative_to(cache).as_posix() for path in cache.rglob("*.npz"))


def test_the_table_names_each_cache(cache):
    lines = size_table(cache).splitlines()
    assert [line.split() for line in lines[1:]] == [
        ["clip", "1", "files", "1.0", "MiB"],
        ["masks", "4", "files", "4.0", "MiB"],
        ["models", "1", "files", "1.0", "MiB"],
        ["all", "6.0", "MiB"],
    ]


def test_no_cache_yet_is_no_error(tmp_path):
    assert "0.0 MiB" in size_table(tmp_path / "nowhere")
    assert prune_cache(tmp_path / "nowhere", [], days=0.0) == (0, 0)


def test_old_entries_go_and_what_is_no_view_stays(cache):
    assert prune_cache(cache, [], days=2.0) == (3, 3.0)
    assert left(cache) == ["masks/.half-written.npz", "masks/0/0.npz", "masks/1/1.npz", "models/99/99.npz"]


def test_the_longest_unused_go_until_the_rest_is_small_enough(cache):
    assert prune_cache(cache, ["masks"], max_mib=2.5) == (2, 2.0)
    assert "masks/1/1.npz" in left(cache)
    assert "masks/2/2.npz" not in left(cache)
    assert "clip/9/9.npz" in left(cache)


def test_a_stage_without_view_cache_is_refused(cache):
    with pytest.raises(HilsplatError, match="there is no cache of finished views for models"):
        prune_cache(cache, ["models"], days=0.0)
    assert len(left(cache)) == 7


def test_without_a_limit_only_what_dead_jobs_left_goes(tmp_path_factory, cache):
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    results = tmp_path_factory.mktemp("project") / "results"
    litter = results / f"photos/desk/.writing-{machine()}-{process.pid}-x"
    litter.mkdir(parents=True)
    shutil.copytree(cache, results / ".cache")
    assert prune_cache(results / ".cache", []) == (0, 0)
    assert not litter.exists()
    assert left(results / ".cache") == left(cache)
