"""Compiled loops are read from the cache exactly if they, and all that they call, are unchanged."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

import cpusplat
from cpusplat import compiled as module

MODULES = {
    "loop_kernels": "from cpusplat.compiled import compiled\nfrom toy.inner_kernels import inner\n\n"
    "@compiled\ndef loop(x):\n    return inner(x) + 1\n",
    "inner_kernels": "from cpusplat.compiled import compiled\n\nFACTOR = 10\n\n"
    "@compiled\ndef inner(x):\n    return FACTOR * x\n",
}

CALL = """
import logging, sys
from pathlib import Path
logging.basicConfig(level=logging.INFO, stream=sys.stderr)
from toy.loop_kernels import loop
if len(sys.argv) > 1:
    module, old, new = sys.argv[1:]
    text = Path(module).read_text()
    assert text.count(old) == 1
    Path(module).write_text(text.replace(old, new))
print(loop(2), sum(loop.stats.cache_hits.values()))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package `toy` with a compiled loop that calls one in another module."""
    root = tmp_path / "toy"
    root.mkdir()
    for name, text in {"__init__": "", **MODULES}.items():
        (root / f"{name}.py").write_text(text)
    return root


def call(package: Path, *edit: str) -> tuple[int, int, int]:
    """`loop(2)` from a new process that first edits a module, number of cache hits, number of notices."""
    paths = (package.parent, Path(cpusplat.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    environment.pop("NUMBA_CACHE_DIR", None)
    # -B: Python takes a compiled module for current if an edit in the same second keeps the size
    command = [sys.executable, "-B", "-c", CALL, *edit]
    done = subprocess.run(
        command, env=environment, cwd=package, capture_output=True, text=True, check=True, timeout=300
    )
    result, hits = done.stdout.split()
    return int(result), int(hits), done.stderr.count("compiling kernels, which takes about 15 s")


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (("loop_kernels.py", "+ 1", "+ 2"), 22),
        (("inner_kernels.py", "FACTOR = 10", "FACTOR = 100"), 201),
        (("inner_kernels.py", "* x", "* x * x"), 41),
    ],
    ids=["own code", "constant", "called loop"],
)
def test_an_edit_between_import_and_call_leaves_no_stale_machine_code(package, edit, expected):
    assert call(package, *edit) == (21, 0, 1), "the process runs the code that it imported"
    assert call(package) == (expected, 0, 1)
    assert call(package) == (expected, 1, 0)


def folder_of(monkeypatch: pytest.MonkeyPatch, package: Path) -> Path:
    """The folder for machine code of `toy`, as a new process computes it."""
    monkeypatch.setitem(sys.modules, "toy", type("Toy", (), {"__path__": [str(package)]}))
    return Path(module._folder_of.__wrapped__("toy"))


def test_a_file_that_was_edited_and_restored_counts_as_new(package, monkeypatch):
    # a process that started before the edit may have imported the edited file
    before, text = folder_of(monkeypatch, package), (package / "inner_kernels.py").read_text()
    assert folder_of(monkeypatch, package) == before
    (package / "other.py").write_text("")
    assert folder_of(monkeypatch, package) == before
    time.sleep(0.01)
    (package / "inner_kernels.py").write_text(text)
    assert folder_of(monkeypatch, package) != before


def test_machine_code_of_other_versions_is_deleted_once_unused(package, monkeypatch):
    for name, days in {
        "kernels-0123456789abcdef": 31,
        "kernels-fedcba9876543210": 29,
        "kernels-mine": 99,
    }.items():
        (package / "__pycache__" / name).mkdir(parents=True)
        old = time.time() - days * 86400
        os.utime(package / "__pycache__" / name, (old, old))
    own = folder_of(monkeypatch, package)
    left = {path.name for path in (package / "__pycache__").iterdir()}
    assert left == {own.name, "kernels-fedcba9876543210", "kernels-mine"}


@pytest.fixture
def read_only(package, monkeypatch) -> Path:
    """A package that cannot be written."""
    monkeypatch.setattr(os, "access", lambda path, mode: not Path(path).is_relative_to(package))
    return package


def test_machine_code_of_a_read_only_package_is_in_the_users_cache(read_only, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert folder_of(monkeypatch, read_only).parent == tmp_path / "cache/cpusplat"
    monkeypatch.setattr(module.config, "CACHE_DIR", str(tmp_path / "chosen"))
    assert folder_of(monkeypatch, read_only).parent == tmp_path / "chosen"


@pytest.mark.parametrize("cache", ["/proc/none", None], ids=["read-only home", "no home"])
def test_machine_code_is_in_a_private_temporary_folder_if_nothing_else_can_be_written(
    read_only, monkeypatch, tmp_path, cache
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as for a user without a name
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if cache:
        monkeypatch.setenv("XDG_CACHE_HOME", cache)
    folder = folder_of(monkeypatch, read_only)
    assert folder.parent == tmp_path / f"cpusplat-{os.getuid()}" == folder_of(monkeypatch, read_only).parent
    assert folder.is_dir() and folder.parent.stat().st_mode & 0o777 == 0o700
    folder.parent.chmod(0o777)  # another user may have written machine code to it
    assert folder_of(monkeypatch, read_only).parent not in (folder.parent, read_only)
