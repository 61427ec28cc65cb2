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


def verdicts(before: list[dict[str, float]], now: list[dict[str, float]]) -> dict[str, str]:
    return {each.case: each.verdict for each in paired(before, now)}


def test_a_difference_must_be_in_every_pair():
    before = [{"a": 10.0, "b": 10.0, "c": 10.0, "d": 10.0}] * 3
    now = [
        {"a": 12.0, "b": 14.0, "c": 10.3, "d": 8.0},
        {"a": 13.0, "b": 14.0, "c": 10.4, "d": 8.5},
        {"a": 11.0, "b": 9.9, "c": 10.2, "d": 7.0},
    ]
    assert verdicts(before, now) == {"a": "slower", "b": "", "c": "", "d": "faster"}


def test_versions_are_compared_within_pairs():
    """The machine became twice as slow after the first pair; the code did not."""
    assert verdicts([{"a": 10.0}, {"a": 20.0}], [{"a": 10.1}, {"a": 19.9}]) == {"a": ""}


def test_a_case_that_one_version_lacks_is_left_out():
    (found,) = paired([{"old": 1.0, "both": 4.0}], [{"both": 5.0, "new": 1.0}])
    assert found.row() == ("both", "4.00", "5.00", "1.25 (1.25 to 1.25)", "slower")
