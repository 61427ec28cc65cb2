"""Runs of Snakemake, faults to inject into them, and the work that a fault destroys."""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.workflow.conftest import Project

POLL_S = 0.25
LEFT_KIB = 64  # space left on a full disk
WAKE_S = 60  # maximum time in which a job that was frozen at its start detects that its Snakemake has ended


@dataclass
class Victim:
    """A job, and how much of its work is not stored yet; times are monotonic."""

    pid: int
    stage: str
    cache: Path  # folder in which the stage stores finished views or a checkpoint
    begun_s: float  # first observation
    kept_s: float  # last change of the cache
    first_s: float | None = None  # duration up to its first stored view, which a new start repeats
    seen_s: float = 0.0  # last observation
    entries: frozenset[tuple[str, int]] | None = None

    def look(self) -> bool:
        """Update the cache entries; return False if the job has ended."""
        if has_ended(self.pid):
            return False
        self.seen_s, entries = time.monotonic(), kept_files(self.cache)
        if self.entries is not None and entries != self.entries:
            if self.first_s is None:
                self.first_s = self.seen_s - self.begun_s
            self.kept_s = self.seen_s
        self.entries = entries
        return True

    @property
    def lost_s(self) -> float:
        """Upper limit of repeated work: the time since the last stored view, plus that up to the first."""
        return min(self.seen_s - self.begun_s, self.seen_s - self.kept_s + (self.first_s or 0.0))


def kept_files(cache: Path) -> frozenset[tuple[str, int]]:
    """Return the finished entries of a cache with their modification times."""
    found = set()
    for path in (path for path in cache.rglob("*") if "/." not in str(path.relative_to(cache.parent))):
        try:
            found.add((str(path), path.stat().st_mtime_ns if path.is_file() else 0))
        except FileNotFoundError:
            continue
    return frozenset(found)


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
        try:
            found += map(int, task.read_text().split())
        except OSError:
            continue
    return found


class Run:
    """A run of Snakemake in a project, started as by a user, and problems that need manual intervention."""

    def __init__(self, project: Project) -> None:
        self.project = project
        self.problems: list[str] = []
        self.jobs: dict[int, Victim] = {}
        self._frozen: list[int] = []
        self._log = project.root / "said.log"
        self._filler = project.root / "results/filler"
        self.start_s = time.monotonic()
        with self._log.open("w") as stream:
            self.process = subprocess.Popen(
                self.command,
                cwd=project.root,
                env=project.environment(),
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def command(self) -> list[str]:
        """The command that a user types."""
        return [sys.executable, "-m", "hilsplat", "run", "--config", "config/ci.yaml", "--", "--cores", "2"]

    def said(self) -> str:
        """Return the end of its output."""
        return self._log.read_text()[-4000:]

    def is_running(self) -> bool:
        """Return whether it has not ended."""
        return self.process.poll() is None

    def look(self) -> list[Victim]:
        """Return the running jobs."""
        for pid in children(self.process.pid):
            if pid not in self.jobs and (stage := stage_of(pid)) is not None:
                now, cache = time.monotonic(), self.project.root / "results/.cache" / stage
                self.jobs[pid] = Victim(pid, stage, cache, begun_s=now, kept_s=now)
        return [job for job in self.jobs.values() if job.look()]

    def what_runs(self) -> str:
        """Return the running stages."""
        return ", ".join(job.stage for job in self.look()) or "nothing"

    def wait_for_a_job(self, limit_s: float) -> float | None:
        """Return the seconds up to its first job, or None if it ends without a job."""
        while self.is_running() and time.monotonic() < self.start_s + limit_s:
            if self.look():
                return time.monotonic() - self.start_s
            time.sleep(POLL_S)
        return None

    def watch_for(self, seconds: float) -> None:
        """Let it run for some time, and observe the caches of its jobs."""
        until = time.monotonic() + seconds
        while self.is_running() and time.monotonic() < until:
            self.look()
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
        for job in self.jobs.values():
            if not has_ended(job.pid):
                self.problems.append(f"{job.stage} (process {job.pid}) outlived its Snakemake")
                os.kill(job.pid, signal.SIGKILL)
        if self._filler.parent.is_mount():
            mounted(self._filler.parent, "-o", "remount,rw")
        self._filler.unlink(missing_ok=True)
        return code

    def kill_snakemake(self, chance: random.Random) -> list[Victim]:
        """Kill only Snakemake, as the kernel does when memory runs out."""
        victims = self.look()
        self.process.kill()
        return victims

    def kill_all(self, chance: random.Random) -> list[Victim]:
        """Kill all processes, as in a power failure."""
        victims = self.look()
        os.killpg(self.process.pid, signal.SIGKILL)
        return victims

    def kill_a_job(self, chance: random.Random) -> list[Victim]:
        """Kill one job; the others continue, and the run ends with an error."""
        victims = self.look()
        chosen = chance.sample(victims, min(1, len(victims)))
        for victim in chosen:
            os.kill(victim.pid, signal.SIGKILL)
        return chosen

    def freeze_orphans(self, chance: random.Random) -> list[Victim]:
        """Freeze the jobs, kill their Snakemake, and wake the jobs later."""
        victims = self.look()
        for victim in victims:
            os.kill(victim.pid, signal.SIGSTOP)
        self._frozen = [victim.pid for victim in victims]
        self.process.kill()
        return victims

    def fill_the_disk(self, chance: random.Random) -> list[Victim]:
        """Fill the disk until the run has ended, so that jobs fail."""
        with contextlib.suppress(OSError), self._filler.open("wb") as stream:  # jobs also write
            room = shutil.disk_usage(self._filler.parent).free
            stream.write(bytes(max(0, room - LEFT_KIB * 1024)))
        return []

    def lock_the_disk(self, chance: random.Random) -> list[Victim]:
        """Make results read-only until the run has ended."""
        for _ in range(40):  # a remount fails while a file is being written
            if mounted(self._filler.parent, "-o", "remount,ro"):
                break
            time.sleep(POLL_S)
        return []

    def clean_up_elsewhere(self, chance: random.Random) -> list[Victim]:
        """Clean up the shared folder as another machine of the same name, with other process numbers."""
        code = "import sys; from hilsplat.base import processes; processes.remove_leftovers(sys.argv[1])"
        command = ["unshare", "--pid", "--fork", "--mount-proc", sys.executable, "-c", code, "results"]
        ended = self._beside(command)
        if ended.returncode:
            self.problems.append(f"no clean-up in another process namespace: {ended.stderr}")
        return []

    def run_twice(self, chance: random.Random) -> list[Victim]:
        """Start a second run in the same project, which must refuse without disturbing the first."""
        second = self._beside(self.command)
        said = second.stdout + second.stderr
        if self.is_running() and (second.returncode == 0 or "another hilsplat run" not in said):
            self.problems.append(f"a second run was not refused:\n{said}")
        return []

    def _beside(self, command: list[str]) -> "subprocess.CompletedProcess[str]":
        """Run a command in the project, and return it with its output."""
        root, environment = self.project.root, self.project.environment()
        return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)


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
    # injects it, and returns the jobs whose work is lost
    strike: Callable[[Run, random.Random], list[Victim]]
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
