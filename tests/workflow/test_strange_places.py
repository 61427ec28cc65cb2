"""A run as an unknown user without a home, with closed streams, beside files named like modules."""

import os
import shutil
import sys
from dataclasses import replace

import pytest

from tests.workflow.conftest import SCENE, Project, given_to_stranger, with_decoys

HILSPLAT = (sys.executable, "-P", "-m", "hilsplat")
TREE = f"{SCENE}/default/coverage_tree"
AGAIN = ("run", "--config", "config/ci.yaml", TREE, "--", "--cores", "2", "--forcerun", TREE)


@pytest.fixture
def place(finished: Project, copy_of_finished: Project) -> Project:
    """A finished run in a folder of decoys; the package is elsewhere."""
    return with_decoys(copy_of_finished.root, finished.root)


def make_again(place: Project, **environment: str) -> None:
    """Make the coverage tree again, and compare it."""
    expected = place.files(TREE)
    done = place.run(*HILSPLAT, *AGAIN, check=False, **environment)
    log = (place.root / SCENE / "default/logs/coverage_tree.log").read_text()
    assert done.returncode == 0, done.stderr + log
    assert log.count("done in") == 1 and place.files(TREE) == expected
    assert not list(place.root.rglob("*.ran"))


@pytest.mark.parametrize("streams", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_command_with_closed_streams_ends_well(place, streams):
    closed = replace(place, before=("sh", "-c", f'exec "$@" {streams}', "sh"))
    closed.run(*HILSPLAT, "export", str(SCENE), "--as", "ply", "--out", "exported")
    assert (place.root / "exported/point_cloud.ply").read_bytes().startswith(b"ply\nformat binary")


def test_a_run_with_closed_streams_and_odd_variables_ends_well(place):
    """As cron and daemons start it; the variables of libraries would stop a job or change its results."""
    odd = {"NUMBA_DISABLE_JIT": "1", "NUMBA_NUM_THREADS": "0", "NUMBA_OPT": "0", "MPLBACKEND": "nonsense"}
    make_again(replace(place, before=("sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh")), **odd)


def test_a_stranger_without_a_home_can_run_and_query(place):
    if os.getuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can become another user")
    stranger = given_to_stranger(place)
    make_again(stranger)
    done = stranger.run(*HILSPLAT, "query", str(SCENE), "mug")
    assert "Traceback" not in done.stderr and "caches are kept in" in done.stderr
    assert "answer to 'mug'" in done.stdout


def test_a_read_only_folder_is_named(place):
    if os.getuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root can become another user")
    stranger = given_to_stranger(place)
    os.chown(place.root, 0, 0)
    done = stranger.run(*HILSPLAT, *AGAIN, "-n", check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "cannot be written, but Snakemake keeps its state there" in done.stderr
