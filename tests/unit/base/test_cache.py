"""The caches: their size, and the entries that are deleted."""

import os
import shutil
import time
from pathlib import Path

import pytest

from hilsplat.base.cache import prune_cache, size_table
from hilsplat.base.errors import HilsplatError
from hilsplat.base.processes import host_token

MIB = 2**20


@pytest.fixture
def cache(tmp_path) -> Path:
    """Entries of 1 MiB: masks unused for 0 to 3 days, a CLIP entry for 9; other files for 99 days."""
    for place, days in (("masks", 0), ("masks", 1), ("masks", 2), ("masks", 3), ("clip", 9), ("models", 99)):
        path = tmp_path / place / f"{days}" / f"{days}.npz"
        path.parent.mkdir(parents=True)
        path.write_bytes(b"x" * MIB)
        used = time.time() - days * 86400 - 60
        os.utime(path, (used, used))
    unfinished = tmp_path / f"masks/.writing-{'0' * 8}-x/new.npz"
    unfinished.parent.mkdir()
    unfinished.write_bytes(b"x")
    (tmp_path / "digests.json").write_bytes(b"x" * MIB)
    return tmp_path


def left(cache: Path) -> list[str]:
    return sorted(path.relative_to(cache).as_posix() for path in cache.rglob("*.npz"))


def test_the_table_names_each_cache(cache):
    lines = size_table(cache).splitlines()
    assert [line.split() for line in lines[1:]] == [
        ["clip", "1", "files", "1.0", "MiB"],
        ["digests.json", "1", "files", "1.0", "MiB"],
        ["masks", "4", "files", "4.0", "MiB"],
        ["models", "1", "files", "1.0", "MiB"],
        ["all", "7.0", "MiB"],
    ]


def test_only_old_view_entries_are_deleted(cache, tmp_path):
    assert prune_cache(tmp_path / "nowhere", [], days=0.0) == (0, 0)
    assert prune_cache(cache, [], days=2.0) == (3, 3.0)
    assert left(cache) == [
        "masks/.writing-00000000-x/new.npz",
        "masks/0/0.npz",
        "masks/1/1.npz",
        "models/99/99.npz",
    ]


def test_an_unknown_cache_is_refused(cache):
    with pytest.raises(HilsplatError, match=r"models\n.*masks, clip, contributions, gaussians"):
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
    (cache / "gaussians").mkdir()
    for name, hours in (("today", 23), ("yesterday", 25), ("old", 240)):
        path = cache / f"gaussians/{name}.npz"
        path.write_bytes(b"x" * MIB)
        written = time.time() - hours * 3600
        os.utime(path, (written, written))
    prune_cache(cache, **options)
    assert {path.stem for path in (cache / "gaussians").iterdir()} == expected


def test_without_a_limit_only_unfinished_files_of_dead_jobs_are_deleted(tmp_path_factory, cache):
    results = tmp_path_factory.mktemp("project") / "results"
    leftover = results / f"photos/desk/.writing-{host_token()}-x"
    leftover.mkdir(parents=True)
    shutil.copytree(cache, results / ".cache")
    assert prune_cache(results / ".cache", []) == (0, 0)
    assert not leftover.exists()
    assert left(results / ".cache") == left(cache)
