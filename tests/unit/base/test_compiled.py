"""Compiled loops are read from the cache exactly if they were compiled from the same code."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

MODULES = {
    "loop": "from hilsplat.base.compiled import compiled\nfrom hilsplat.inner import inner\n\n"
    "@compiled\ndef loop(x):\n    return inner(x) + 1\n",
    "inner": "from hilsplat.base.compiled import compiled\n\nFACTOR = 10\n\n"
    "@compiled\ndef inner(x):\n    return FACTOR * x\n",
}

CALL = """
import sys
from pathlib import Path
from hilsplat.loop import loop
if len(sys.argv) > 1:
    module, old, new = sys.argv[1:]
    text = Path(module).read_text()
    assert text.count(old) == 1
    Path(module).write_text(text.replace(old, new))
print(loop(2), sum(loop.stats.cache_hits.values()))
"""


@pytest.fixture
def package(project: Path, tmp_path: Path) -> Path:
    """A package `hilsplat` with a compiled loop that calls one in another module."""
    root = tmp_path / "hilsplat"
    shutil.copytree(project / "hilsplat/base", root / "base", ignore=shutil.ignore_patterns("__pycache__"))
    for name, text in {"__init__": "", **MODULES}.items():
        (root / f"{name}.py").write_text(text)
    return root


def call(package: Path, *edit: str) -> tuple[int, int]:
    """Return `loop(2)` from a new process that first edits a module, and the number of cache hits."""
    environment = {**os.environ, "PYTHONPATH": str(package.parent)}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-c", CALL, *edit]
    done = subprocess.run(
        command, env=environment, cwd=package, capture_output=True, text=True, check=True, timeout=300
    )
    result, hits = done.stdout.split()
    return int(result), int(hits)


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (("loop.py", "+ 1", "+ 2"), 22),
        (("inner.py", "FACTOR = 10", "FACTOR = 100"), 201),
        (("inner.py", "* x", "* x * x"), 41),
        (("inner.py", "* x", "* x)"), None),
    ],
    ids=["own code", "constant", "called loop", "unfinished edit"],
)
def test_an_edit_between_import_and_call_leaves_no_stale_machine_code(package, edit, expected):
    assert call(package, *edit) == (21, 0), "the process runs the code that it imported"
    if expected is not None:
        assert call(package) == (expected, 0)
        assert call(package) == (expected, 1)
