"""What got slower since another commit: paired, interleaved runs of the benchmarks of both.

    python -m benchmarks.compare main~5 -k forward     # or: make bench BASE=main~5

A time of yesterday says little about a machine that is shared today, so both versions run here and now, in
turn, each in processes of its own. A case counts as slower if it was slower in every pair, and by more than
`NOISE` in the median pair.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.table import markdown_table

NOISE = 1.08
"""Median ratio of times up to which a case counts as equal: runs of the same code differ by as much."""

Run = Mapping[str, float]
"""Name of a case -> its least time, ms."""


@dataclass(frozen=True)
class Paired:
    """A case in all pairs.

    Attributes:
        case: its name.
        before_ms: least time with the other commit.
        now_ms: least time with the working tree.
        ratios: time now over time before, one per pair.
    """

    case: str
    before_ms: float
    now_ms: float
    ratios: tuple[float, ...]

    @property
    def verdict(self) -> str:
        """ "slower" or "faster" if every pair says so and the median pair clearly; otherwise empty."""
        median = statistics.median(self.ratios)
        if min(self.ratios) > 1 and median > NOISE:
            return "slower"
        return "faster" if max(self.ratios) < 1 and median < 1 / NOISE else ""

    def row(self) -> tuple[str, ...]:
        """Row of the table."""
        least, median, most = min(self.ratios), statistics.median(self.ratios), max(self.ratios)
        spread = f"{median:.2f} ({least:.2f} to {most:.2f})"
        return self.case, f"{self.before_ms:.2f}", f"{self.now_ms:.2f}", spread, self.verdict


def paired(before: Sequence[Run], now: Sequence[Run]) -> list[Paired]:
    """Compare the cases that every run of both versions has, in the order of the first run.

    Args:
        before: runs of the other commit.
        now: runs of the working tree; the k-th belongs to the k-th of `before`.
    """
    common = [case for case in now[0] if all(case in run for run in (*before, *now))]
    return [
        Paired(
            case,
            min(run[case] for run in before),
            min(run[case] for run in now),
            tuple(new[case] / old[case] for old, new in zip(before, now, strict=True)),
        )
        for case in common
    ]


@contextmanager
def checked_out(commit: str, folder: Path) -> Iterator[Path]:
    """A commit's files in a folder, as a work tree of this repository that is removed afterwards."""
    subprocess.run(["git", "worktree", "add", "--quiet", "--detach", folder, commit], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", folder], check=True)


def run_benchmarks(tree: Path, out: Path, options: Sequence[str]) -> Run:
    """Run a tree's benchmarks in one process and read their least times."""
    command = [sys.executable, "-m", "pytest", "-c", "benchmarks/pytest.ini", "benchmarks", "--out", str(out)]
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, *options], cwd=tree, env=environment, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"{done.stdout}\nthe benchmarks of {tree} failed")
    cases = json.loads((out / "benchmarks.json").read_text(encoding="utf-8"))["cases"]
    return {f"{case['room']}: {case['case']}": case["least_ms"] for case in cases}


def main() -> int:
    """Compare and print; 1 if a case got slower."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compare", description=__doc__.split("\n")[0])
    parser.add_argument("base", help="commit to compare the working tree with")
    parser.add_argument("-k", dest="select", default="", help="cases to run, as pytest selects them")
    parser.add_argument("--pairs", type=int, default=3, help="runs of each version")
    asked = parser.parse_args()
    options = ["-k", asked.select] if asked.select else []
    runs: dict[str, list[Run]] = {"before": [], "now": []}
    with tempfile.TemporaryDirectory() as scratch, checked_out(asked.base, Path(scratch, "tree")) as other:
        trees = {"before": other, "now": Path.cwd()}
        for pair in range(asked.pairs):
            for which in sorted(trees, reverse=pair % 2 == 1):  # each version is first in turn
                print(f"pair {pair + 1} of {asked.pairs}: {which}", file=sys.stderr)
                out = Path(scratch, f"{which}-{pair}")
                runs[which].append(run_benchmarks(trees[which], out, options))
    found = paired(runs["before"], runs["now"])
    head = ("case", f"{asked.base}, ms", "now, ms", "ratio: median pair (all)", "")
    print(markdown_table(head, [each.row() for each in found]))
    slower = [each.case for each in found if each.verdict == "slower"]
    print(f"\nslower: {', '.join(slower) or 'nothing'}")
    return 1 if slower else 0


if __name__ == "__main__":
    sys.exit(main())
