"""Inject faults into runs and commands, which must recover without manual help.

    make chaos                                       # 30 kills, seed 0
    python -m tests.chaos --kills 5 --seed 3 --work ../chaos
    python -m tests.chaos --strange                  # the same as an unknown user, in a strange place

A fault is injected into a run at a random time; then the same command is started again. When the run is
complete, its tables are compared byte by byte with those of an undisturbed run, and the next run starts
without results. After that, user commands are killed while they write (`commands`). The final report
lists the faults. The exit code is 1 if a table differs, or if a start without a fault failed.

With --strange, the runs belong to a user without a name, home and cache, some or all of their standard
streams are closed, and the working folder contains files named like modules (needs root and setpriv).

The faults of a full and a read-only disk need results on a small tmpfs; they are skipped with a notice if
this user may not mount one.
"""

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from tests.chaos.commands import kill_commands
from tests.chaos.faults import FAULTS, STREAMS, Run, mounted
from tests.conftest import PROJECT
from tests.workflow.conftest import Project, copy_project, given_to_stranger, with_decoys

DISK_MIB = 1000  # size of the results disk, MiB; the ci configuration needs less than a tenth of it
MAX_FINISHED = 5  # maximum number of complete runs per kill; with more, jobs are not seen
SLACK_S = 3600  # maximum time of a start without a fault, in addition to that of the undisturbed run


@dataclass
class Tally:
    """Faults, complete runs, and problems that need manual intervention so far."""

    kills: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    finished: int = 0
    problems: list[str] = field(default_factory=list)

    def report(self) -> str:
        """Return the final lines of output."""
        lines = [f"{self.kills} kills, {self.finished} complete runs"]
        lines += [f"  {name}: {count}" for name, count in sorted(self.faults.items())]
        lines += [f"PROBLEM {problem}" for problem in self.problems]
        if not self.problems:
            lines.append("no manual intervention was needed, and no table differs")
        return "\n".join(lines)


def tables(project: Project) -> dict[str, bytes]:
    """Return every table except those of timings."""
    files = project.files("results/tables")
    return {
        name: content
        for name, content in files.items()
        if not name.endswith(".provenance.json") and "-seconds." not in name
    }


def undisturbed(work: Path) -> tuple[Project, float]:
    """Return a copy of the project with a complete run, and the duration of the run in seconds."""
    project, seconds = Project(work / "undisturbed"), work / "undisturbed.seconds"
    if not seconds.exists():
        shutil.rmtree(project.root, ignore_errors=True)
        start = time.monotonic()
        run = Run(copy_project(PROJECT, project.root, results=False))
        if run.wait() != 0:
            sys.exit(f"the undisturbed run failed:\n{run.said()}")
        seconds.write_text(f"{time.monotonic() - start:.0f}\n")
    return project, float(seconds.read_text())


def torment(
    project: Project, reference: Project, whole_s: float, options: argparse.Namespace, disk: bool
) -> Tally:
    """Inject faults into runs until there are enough kills, and let the last run complete."""
    chance, tally = random.Random(options.seed), Tally()
    faults = [fault for fault in FAULTS if disk or not fault.needs_disk]
    while True:
        run, may_fail = Run(project, chance.choice(STREAMS) if options.strange else ""), False
        run.watch_for(whole_s + SLACK_S, until_a_job=True)
        while run.is_running() and tally.kills < options.kills:
            run.watch_for(chance.uniform(0, 4 * whole_s / options.kills))  # two runs' worth
            if not run.is_running():
                break
            fault = chance.choices(faults, [3 if each.kills else 1 for each in faults])[0]
            print(f"{tally.kills} kills; now {fault.name}: {run.what_runs()}", flush=True)
            fault.strike(run, chance)
            tally.faults[fault.name] += 1
            tally.kills += fault.kills
            may_fail = may_fail or fault.may_fail
            if fault.ends_run:
                break
        code = run.wait(whole_s + SLACK_S)
        tally.problems += run.problems
        if code != 0 and not may_fail:
            tally.problems.append(f"a start without a fault ended with {code}:\n{run.said()}")
            return tally
        if code == 0:
            tally.finished += 1
            tally.problems += differences(reference, project)
            if tally.finished > MAX_FINISHED * (tally.kills + 1):
                tally.problems.append(f"only {tally.kills} kills in {tally.finished} complete runs")
        if tally.problems or (code == 0 and tally.kills >= options.kills):
            return tally
        if code == 0:
            for part in (project.root / "results").iterdir():
                shutil.rmtree(part) if part.is_dir() else part.unlink()
            shutil.rmtree(project.root / ".snakemake")
            shutil.rmtree(project.root / ".hilsplat")


def differences(reference: Project, project: Project) -> list[str]:
    """Return the differences from an undisturbed run."""
    expected, found, results = tables(reference), tables(project), project.root / "results"
    names = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
    left = sorted(str(path) for path in results.rglob(".writing-*"))
    return [f"results/tables/{name} differs from that of the undisturbed run" for name in names] + [
        f"{path} was left behind" for path in left
    ]


def main() -> None:
    """Parse the command line, run, and report."""
    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=30, help="number of kills")
    parser.add_argument("--seed", type=int, default=0, help="seed of times and faults")
    parser.add_argument("--strange", action="store_true", help="run as an unknown user in a strange place")
    parser.add_argument("--work", type=Path, help="working folder; its undisturbed run is reused")
    options = parser.parse_args()
    work = options.work or Path(tempfile.mkdtemp(prefix="hilsplat-chaos-"))
    work.mkdir(parents=True, exist_ok=True)
    reference, whole_s = undisturbed(work)
    print(f"the undisturbed run in {work} took {whole_s:.0f} s", flush=True)
    root = work / f"disturbed-{os.getpid()}"
    project = copy_project(PROJECT, root, results=False)
    results = root / "results"
    results.mkdir(parents=True)
    disk = mounted(results, "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs")
    if not disk:
        print("no full or read-only disk: this user may not mount a tmpfs", flush=True)
    if options.strange:
        project = given_to_stranger(with_decoys(root, reference.root))
    try:
        tally = torment(project, reference, whole_s, options, disk)
        chance = random.Random(options.seed)
        tally.problems += [f"{path} was run" for path in root.rglob("*.ran")]
        tally.problems += kill_commands(root / "commands", max(1, options.kills // 3), chance)
        kept = bool(tally.problems)
        if kept:
            shutil.copytree(results, root / "results-kept", symlinks=True)
            print(f"kept for inspection: {root}")
    finally:
        if disk:
            subprocess.run(["umount", "--lazy", str(results)], check=False)
    print(tally.report(), flush=True)
    if kept:
        sys.exit(1)
    shutil.rmtree(root if options.work else work)


if __name__ == "__main__":
    main()
