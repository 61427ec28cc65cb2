"""Shared fixtures and the rules that hold for all tests."""

import logging
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

from tests import lazy_checks

PROJECT = Path(__file__).resolve().parents[1]

CHECKED = "HILSPLAT_CHECKED"
"""If this environment variable is set, as in one job of CI, the shapes and types of arguments and results are
checked at every call. Tests then take up to twice the CPU time."""

UNCHECKED = (
    "hilsplat.base.code",
    "hilsplat_world.objects.",
    "hilsplat_world.paints",
    "hilsplat_world.shapes",
)
"""Modules of small functions that are called tens of thousands of times; checks would take five times as long
as the tests themselves."""

if os.environ.get(CHECKED):
    packages = ("cpusplat", "hilsplat", "hilsplat_world", "models/training")
    sources = [path for package in packages for path in (PROJECT / package).rglob("[!_]*.py")]
    files = [".".join(path.relative_to(PROJECT).with_suffix("").parts) for path in sources]
    checked = [name for name in files if not name.startswith(UNCHECKED)]
    install_import_hook(checked, f"{lazy_checks.__name__}.checked")

# Two test processes with two threads each on two cores are five times as slow.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"  # as in hilsplat.cli.main
os.environ.setdefault("MPLBACKEND", "Agg")
# Processes that tests start run the code of this checkout.
os.environ["PYTHONPATH"] = os.pathsep.join([str(PROJECT), *filter(None, [os.environ.get("PYTHONPATH")])])
os.environ["HILSPLAT_MODELS"] = "models"  # whatever the user of this machine has fetched

# No test fails for being slow on a busy machine, and every run tries the same examples.
settings.register_profile("hilsplat", deadline=None, derandomize=True)
settings.load_profile("hilsplat")
settings.register_profile("chaos", deadline=None, max_examples=5000)


@pytest.fixture(scope="session")
def project() -> Path:
    """Root of the checkout."""
    return PROJECT


@pytest.fixture(scope="session")
def desk_project(tmp_path_factory) -> Path:
    """A project folder with models/colours and the finished results/photos/desk; change only copies of it."""
    from tests.unit.finished_desk import build_finished_desk

    return build_finished_desk(tmp_path_factory.mktemp("project"))


@pytest.fixture(scope="session")
def desk(desk_project) -> Path:
    """The folder of the finished scene in `desk_project`."""
    return desk_project / "results/photos/desk"


@pytest.fixture
def own_desk(desk_project, tmp_path) -> Path:
    """A copy of the finished scene, in a copy of its project, to change."""
    return shutil.copytree(desk_project, tmp_path / "project") / "results/photos/desk"


@pytest.fixture
def three_scenes(desk_project, tmp_path) -> Path:
    """Results with the desk, a copy of it, and a scene with poses only; the desk's model is beside them."""
    shutil.copytree(desk_project / "models", tmp_path / "models")
    desk, photos = desk_project / "results/photos/desk", tmp_path / "results/photos"
    for name in ("desk", "other"):
        shutil.copytree(desk, photos / name)
    shutil.copytree(desk / "scene", photos / "posed/scene")
    return tmp_path / "results"


@pytest.fixture(autouse=True)
def own_log() -> Iterator[None]:
    """Remove the log handlers that a command added: they write to the captured output of its test."""
    before = list(logging.getLogger().handlers)
    yield
    logging.getLogger().handlers[:] = before


@pytest.fixture(autouse=True)
def cache_folder_of_tests(monkeypatch, tmp_path_factory) -> None:
    """Keep what is remembered about networks out of the user's cache folder."""
    folder = tmp_path_factory.getbasetemp() / "user-cache"
    monkeypatch.setattr("platformdirs.user_cache_path", lambda *name: folder)
