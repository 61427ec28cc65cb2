"""Benchmarks run, untimed; a case counts as slower only if it clearly is in every pair of runs."""

import subprocess
import sys
from pathlib import Path

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
