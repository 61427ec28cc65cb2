"""The next run tidies up after one that was killed."""

import subprocess
import sys

import pytest

from hilsplat.base.processes import machine
from hilsplat.workflow import takeover
from hilsplat.workflow.takeover import take_over

HOLD = """
import sys, time
from pathlib import Path
from hilsplat.workflow.takeover import take_over
print(take_over(Path(sys.argv[1]), Path("nowhere")), flush=True)
time.sleep(60)
"""


@pytest.fixture
def state(tmp_path, monkeypatch):
    """Snakemake's folder, with the lock of a run."""
    monkeypatch.setattr(takeover, "_held", [])
    (tmp_path / "locks").mkdir()
    (tmp_path / "locks/0.input.lock").write_text("a\n")
    return tmp_path


def test_the_lock_of_a_killed_run_is_lifted_and_that_of_a_live_one_is_not(state):
    run = subprocess.Popen([sys.executable, "-c", HOLD, state], stdout=subprocess.PIPE, text=True)
    assert run.stdout.readline() == "None\n", "no run of ours made this lock"
    assert take_over(state, state) is None
    assert list((state / "locks").iterdir()), "its run is alive"
    run.kill()
    run.wait()
    assert f"run that was killed (process {run.pid})" in take_over(state, state)
    assert not list((state / "locks").iterdir())


def test_the_lock_of_another_machine_stays(state):
    (state / "hilsplat.lock").write_text("00000000 123\n")
    assert take_over(state, state) is None
    assert list((state / "locks").iterdir())


def test_a_run_that_ended_well_is_not_mentioned(state):
    (state / "hilsplat.lock").write_text(f"{machine()} 123\n")
    (state / "locks/0.input.lock").unlink()
    assert take_over(state, state) is None
