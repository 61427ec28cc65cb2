"""Runs of Snakemake, and faults to inject into them."""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from tests.workflow.conftest import Project

STREAMS = ("", "<&-", "<&- >&-", "<&- >&- 2>&-")
"""Redirections of a run among strangers: no stream, some or all are closed, as by cron and daemons."""
COMMAND = (sys.executable, "-P", "-m", "hilsplat", "run", "--config", "config/ci.yaml", "--", "--cores", "2")
POLL_S = 0.25
LEFT_KIB = 64  # space left on a full disk
WAKE_S = 60  # maximum time in which a job that was frozen at its start detects that its Snakemake has ended


def has_ended(pid: int) -> bool:
    """Return whether a process has ended, even if nothing has waited for it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


def children(pid: int) -> list[int]:
    """Return the processes that any thread of a process started."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found += map(int, task.read_text().split())
    return found


def descendants(pid: int) -> list[int]:
    """Return the processes that a process or its descendants started."""
    return [each for child in children(pid) for each in (child, *descendants(child))]


class Run:
    """A run of `COMMAND` in a project, and problems that need manual intervention."""

    def __init__(self, project: Project, streams: str = "") -> None:
        """Start a run; `streams` are redirections of a shell, such as "<&-", which closes stdin."""
        self.project = project
        self.problems: list[str] = []
        self.jobs: dict[int, str] = {}  # process -> stage
        self._frozen: list[int] = []
        self._log = project.root / "said.log"
        self._filler = project.root / "results/filler"
        with self._log.open("w") as stream:
            closing = ("sh", "-c", f'exec "$@" {streams}', "sh") if streams else ()
            self.process = project.start(*closing, *COMMAND, output=stream)

    def said(self) -> str:
        """Return the end of its output."""
        return self._log.read_text()[-4000:]

    def is_running(self) -> bool:
        return self.process.poll() is None

    def look(self) -> list[int]:
        """Return the processes of the running jobs."""
        for pid in descendants(self.process.pid):  # Snakemake, and its jobs
            if pid not in self.jobs and (stage := stage_of(pid)) is not None:
                self.jobs[pid] = stage
        return [pid for pid in self.jobs if not has_ended(pid)]

    def what_runs(self) -> str:
        return ", ".join(self.jobs[pid] for pid in self.look()) or "nothing"

    def watch_for(self, seconds: float, until_a_job: bool = False) -> None:
        """Let it run for some time, or until its first job has begun, and observe its jobs."""
        until = time.monotonic() + seconds
        while self.is_running() and time.monotonic() < until:
            if self.look() and until_a_job:
                break
            time.sleep(POLL_S)

    def wait(self, limit_s: float = 7200) -> int:
        """Wait for it and return its exit code; jobs that outlive it are a problem."""
        try:
            code = self.process.wait(timeout=limit_s)
        except subprocess.TimeoutExpired:
            self.problems.append(f"it did not end within {limit_s:.0f} s:\n{self.said()}")
            os.killpg(self.process.pid, signal.SIGKILL)
            code = self.process.wait()
        for pid in self._frozen:  # or it would run beside the next run
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        until = time.monotonic() + WAKE_S
        while not all(map(has_ended, self.jobs)) and time.monotonic() < until:
            time.sleep(POLL_S)
        for pid, stage in self.jobs.items():
            if not has_ended(pid):
                self.problems.append(f"{stage} (process {pid}) outlived its Snakemake")
                os.kill(pid, signal.SIGKILL)
        if self._filler.parent.is_mount():
            mounted(self._filler.parent, "-o", "remount,rw")
        self._filler.unlink(missing_ok=True)
        return code

    def kill_snakemake(self, chance: random.Random) -> None:
        """Kill only Snakemake, or the command that started it, as the kernel does when memory runs out."""
        os.kill(chance.choice([self.process.pid, *children(self.process.pid)]), signal.SIGKILL)

    def kill_all(self, chance: random.Random) -> None:
        """Kill all processes, as in a power failure."""
        os.killpg(self.process.pid, signal.SIGKILL)

    def kill_a_job(self, chance: random.Random) -> None:
        """Kill one job; the others continue, and the run ends with an error."""
        if running := self.look():
            os.kill(chance.choice(running), signal.SIGKILL)

    def freeze_orphans(self, chance: random.Random) -> None:
        """Freeze the jobs, kill their Snakemake, and wake the jobs later."""
        self._frozen = self.look()
        for pid in self._frozen:
            os.kill(pid, signal.SIGSTOP)
        for pid in (*children(self.process.pid), self.process.pid):
            os.kill(pid, signal.SIGKILL)

    def fill_the_disk(self, chance: random.Random) -> None:
        """Fill the disk until the run has ended, so that jobs fail."""
        with contextlib.suppress(OSError), self._filler.open("wb") as stream:  # jobs also write
            room = shutil.disk_usage(self._filler.parent).free
            stream.write(bytes(max(0, room - LEFT_KIB * 1024)))

    def lock_the_disk(self, chance: random.Random) -> None:
        """Make results read-only until the run has ended."""
        for _ in range(40):  # a remount fails while a file is being written
            if mounted(self._filler.parent, "-o", "remount,ro"):
                break
            time.sleep(POLL_S)

    def clean_up_elsewhere(self, chance: random.Random) -> None:
        """Clean up the shared folder as another machine of the same name, with other process numbers."""
        code = "import sys; from hilsplat.base import processes; processes.remove_leftovers(sys.argv[1])"
        command = ("unshare", "--pid", "--fork", "--mount-proc", sys.executable, "-P", "-c", code)
        itself = replace(self.project, before=())  # only root may unshare
        ended = itself.run(*command, "results", check=False)
        if ended.returncode:
            self.problems.append(f"no clean-up in another process namespace: {ended.stderr}")

    def run_twice(self, chance: random.Random) -> None:
        """Start a second run in the same project, which must refuse without disturbing the first."""
        second = self.project.run(*COMMAND, check=False)
        said = second.stdout + second.stderr
        if self.is_running() and (second.returncode == 0 or "another hilsplat run" not in said):
            self.problems.append(f"a second run was not refused:\n{said}")


def mounted(folder: Path, *options: str) -> bool:
    """Mount a folder with these options; return False if this user may not, or if the disk is in use."""
    command = ["mount", *options, str(folder)]
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def stage_of(pid: int) -> str | None:
    """Return the subcommand of a job, or None for other processes."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return None
    # Jobs have the option --log; `hilsplat run` does not.
    return words[words.index("--log") + 2] if "hilsplat" in words and "--log" in words else None


@dataclass(frozen=True)
class Fault:
    """A fault to inject into a run."""

    name: str
    strike: Callable[[Run, random.Random], None]
    kills: bool = True  # whether it counts as a kill
    needs_disk: bool = False  # whether results must be on a separate disk
    may_fail: bool = True  # whether the run may end with an error
    ends_run: bool = True  # whether the run ends immediately


FAULTS = (
    Fault("kill Snakemake", Run.kill_snakemake),
    Fault("kill Snakemake and its jobs", Run.kill_all),
    Fault("kill a job", Run.kill_a_job, ends_run=False),
    Fault("freeze the jobs, kill Snakemake", Run.freeze_orphans),
    Fault("fill the disk", Run.fill_the_disk, kills=False, needs_disk=True, ends_run=False),
    Fault("make results read-only", Run.lock_the_disk, kills=False, needs_disk=True, ends_run=False),
    Fault("clean up on another machine", Run.clean_up_elsewhere, kills=False, may_fail=False, ends_run=False),
    Fault("start a second run", Run.run_twice, kills=False, may_fail=False, ends_run=False),
)
