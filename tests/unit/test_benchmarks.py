"""Benchmarks run, untimed; a case counts as slower only if it clearly is in every pair of runs."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.compare import paired

ROOT = Path(__file__).resolve().parents[2]


def test_every_benchmark_runs():
    """Run them untimed, so that a changed interface is noticed."""
    command = ["-m", "pytest", "-c", "benchmarks/pytest.ini", "benchmarks", "--benchmark-disable"]
    heavy = "not (two_threads or suppression or linkage or memory or 100k or 800x600)"
    done = subprocess.run(
        [sys.executable, *command, "-k", heavy], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert done.returncode == 0, done.stdout


def test_what_needs_a_card_runs_on_the_cpu(tmp_path: Path):
    command = [sys.executable, "-m", "benchmarks.gpu", "--device", "cpu", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == 0, done.stdout
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert found["parity"]["differs"] == "" and found["slots"]["seconds"] >= 4
    assert all(row["step_ms"] > 0 and row["longest_ms"] for row in found["steps"]["steps"])
    assert found["fit"]["cuda"]["psnr_db"] == pytest.approx(found["fit"]["cpu"]["psnr_db"], abs=0.5)
    assert {"sam-tiny", "clip-tiny"} <= found["networks"].keys()
    assert (tmp_path / "gpu.md").read_text().count("\n| ") >= 9


def test_a_difference_must_be_in_every_pair_of_one_moment():
    before = [
        {"a": 10.0, "b": 10.0, "c": 10.0, "d": 10.0, "e": pace, "old": 1.0} for pace in (10.0, 20.0, 10.0)
    ]
    now = [
        {"a": 12.0, "b": 14.0, "c": 10.3, "d": 8.0, "e": 10.1, "new": 1.0},
        {"a": 13.0, "b": 14.0, "c": 10.4, "d": 8.5, "e": 19.9, "new": 1.0},  # the machine was slower
        {"a": 11.0, "b": 9.9, "c": 10.2, "d": 7.0, "e": 10.0, "new": 1.0},
    ]
    verdicts = {each.case: each.verdict for each in paired(before, now)}
    assert verdicts == {"a": "slower", "b": "", "c": "", "d": "faster", "e": ""}
