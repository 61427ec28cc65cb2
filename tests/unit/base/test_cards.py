"""Cards: how many a process may use, and the lock on each."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilsplat.base import cards as module
from hilsplat.base.cards import cards, release_card, take_card

HOLD = """
import os, sys
from pathlib import Path
from hilsplat.base.cards import take_card
take_card(Path(sys.argv[1]), 0.01)
print(os.environ["CUDA_VISIBLE_DEVICES"], flush=True)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def no_scheduler(monkeypatch):
    for name in ("SLURM_JOB_ID", "CUDA_VISIBLE_DEVICES", "CUDA_DEVICE_ORDER"):
        monkeypatch.setenv(name, "")  # so that it is restored
        monkeypatch.delenv(name)
    yield
    release_card()


def driver(number: int) -> SimpleNamespace:
    """The driver's library on a machine with a number of cards."""

    def count(pointer) -> int:
        pointer._obj.value = number
        return 0

    return SimpleNamespace(nvmlInit_v2=lambda: 0, nvmlDeviceGetCount_v2=count, nvmlShutdown=lambda: 0)


def test_the_driver_counts_the_cards_unless_the_variable_names_them(monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: driver(3))
    assert cards() == ["0", "1", "2"]
    for named, expected in (("2,0", ["2", "0"]), ("", []), ("-1", []), ("GPU-8f2a, 1", ["GPU-8f2a", "1"])):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", named)
        assert cards() == expected


def test_without_a_driver_there_is_no_card(monkeypatch, tmp_path):
    def absent(name):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(ctypes, "CDLL", absent)
    take_card(tmp_path)
    assert cards() == [] and not list(tmp_path.iterdir())


@pytest.mark.parametrize("order", [None, "FASTEST_FIRST"])
def test_the_order_that_gives_names_their_meaning_is_kept(monkeypatch, tmp_path, order):
    if order:
        monkeypatch.setenv("CUDA_DEVICE_ORDER", order)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    take_card(tmp_path)
    assert (os.environ["CUDA_VISIBLE_DEVICES"], os.environ.get("CUDA_DEVICE_ORDER")) == ("1", order)


def holder(folder: Path, visible: str, **environment: str) -> subprocess.Popen:
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": visible, **environment}
    command = [sys.executable, "-P", "-c", HOLD, str(folder)]
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def test_jobs_get_cards_of_their_own_and_wait_for_one(tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    with holder(tmp_path, "0,1") as first, holder(tmp_path, "0,1") as second:
        assert {first.stdout.readline(), second.stdout.readline()} == {"0\n", "1\n"}
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
        monkeypatch.setattr(module.time, "sleep", lambda seconds: second.kill())
        take_card(tmp_path)
        assert "waiting for one of 2 cards" in caplog.text
        freed = os.environ["CUDA_VISIBLE_DEVICES"]
        assert freed in ("0", "1")
        with holder(tmp_path, freed) as third:
            release_card()  # as a job does that uses the CPU after all
            assert third.stdout.readline() == f"{freed}\n"
            third.kill()
        first.kill()


def test_processes_of_one_slurm_job_share_its_cards(tmp_path):
    jobs = ("7", "7", "8")  # the scheduler names the cards of each job from 0
    holders = [holder(tmp_path, "0,1", SLURM_JOB_ID=job) for job in jobs]
    names = [each.stdout.readline().strip() for each in holders]
    for each in holders:
        each.communicate()
    assert {*names[:2]} == {"0", "1"} and names[2] == "0"
