"""Compare benchmark timings with those of another commit, in paired, interleaved runs.

    python -m benchmarks.compare main~5 -k forward     # or: make bench BASE=main~5

Timings from different days are not comparable on a shared machine, so both versions run alternately, each in
its own processes. A case is slower if it was slower in every pair, and by more than `NOISE` in the median
pair.
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

NOISE = 1.08  # median ratio of times up to which a case counts as equal; runs of the same code differ as much
Run = Mapping[str, float]  # name of a case -> its minimum time, ms


@dataclass(frozen=True)
class Paired:
    """Timings of a case in all pairs."""

    case: str  # its name
    before_ms: float  # minimum time with the other commit
    now_ms: float  # minimum time with the working tree
    ratios: tuple[float, ...]  # time now divided by time before, one per pair

    @property
    def verdict(self) -> str:
        """ "slower" or "faster" if all pairs agree and the median ratio exceeds `NOISE`, otherwise empty."""
        median = statistics.median(self.ratios)
        if min(self.ratios) > 1 and median > NOISE:
            return "slower"
        return "faster" if max(self.ratios) < 1 and median < 1 / NOISE else ""

    def row(self) -> tuple[str, ...]:
        """Return the row of the table."""
        least, median, most = min(self.ratios), statistics.median(self.ratios), max(self.ratios)
        spread = f"{median:.2f} ({least:.2f} to {most:.2f})"
        return self.case, f"{self.before_ms:.2f}", f"{self.now_ms:.2f}", spread, self.verdict


def paired(before: Sequence[Run], now: Sequence[Run]) -> list[Paired]:
    """Compare the cases that are in every run of both versions, in the order of the first run.

    Runs of the other commit and of the working tree at the same position are a pair.
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
    """Check a commit out into a folder as a temporary work tree of this repository."""
    subprocess.run(["git", "worktree", "add", "--quiet", "--detach", folder, commit], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", folder], check=True)


def run_benchmarks(tree: Path, out: Path, options: Sequence[str]) -> Run:
    """Run a tree's benchmarks in one process and read their minimum times."""
    command = [sys.executable, "-m", "pytest", "-c", "benchmarks/pytest.ini", "benchmarks", "--out", str(out)]
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, *options], cwd=tree, env=environment, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"{done.stdout}\nthe benchmarks of {tree} failed")
    cases = json.loads((out / "benchmarks.json").read_text(encoding="utf-8"))["cases"]
    return {f"{case['room']}: {case['case']}": case["least_ms"] for case in cases}


def main() -> int:
    """Compare and print; return 1 if a case is slower, otherwise 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compare", description=__doc__.split("\n")[0])
    parser.add_argument("base", help="commit to compare the working tree with")
    parser.add_argument("-k", dest="select", default="", help="cases to run, as pytest selects them")
    parser.add_argument("--pairs", type=int, default=3, help="runs of each version")
    given = parser.parse_args()
    options = ["-k", given.select] if given.select else []
    runs: dict[str, list[Run]] = {"before": [], "now": []}
    with tempfile.TemporaryDirectory() as scratch, checked_out(given.base, Path(scratch, "tree")) as other:
        trees = {"before": other, "now": Path.cwd()}
        for pair in range(given.pairs):
            for which in sorted(trees, reverse=pair % 2 == 1):  # each version runs first in every other pair
                print(f"pair {pair + 1} of {given.pairs}: {which}", file=sys.stderr)
                out = Path(scratch, f"{which}-{pair}")
                runs[which].append(run_benchmarks(trees[which], out, options))
    pairs = paired(runs["before"], runs["now"])
    head = ("case", f"{given.base}, ms", "now, ms", "ratio: median pair (all)", "")
    print(markdown_table(head, [comparison.row() for comparison in pairs]))
    slower = [comparison.case for comparison in pairs if comparison.verdict == "slower"]
    print(f"\nslower: {', '.join(slower) or 'nothing'}")
    return 1 if slower else 0


if __name__ == "__main__":
    sys.exit(main())
