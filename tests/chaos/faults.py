"""A run of Snakemake that can be hit, what hits it, and what that costs."""

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

from hilsplat.base.processes import is_alive
from tests.workflow.conftest import Project

POLL_S = 0.25
TICKS = os.sysconf("SC_CLK_TCK")
LEFT_KIB = 64
"""What a full disk still takes."""
WAKE_S = 60
"""A job that was frozen while it began may take so long to see that its Snakemake has ended."""


@dataclass
class Victim:
    """A job, and how much of its work is not kept anywhere yet.

    Attributes:
        pid: its process.
        stage: its subcommand.
        cache: where the stage keeps finished views or a checkpoint.
        begun_s: when it was first seen, as the next.
        kept_s: when it last put something there.
        kept_cpu_s: processor seconds that it had taken by then.
        first_s: what it took to its first view, which a new start takes again; likewise in processor time.
        seen_s: when it was last seen.
        cpu_s: processor seconds that it has taken.
        entries: what the cache holds.
    """

    pid: int
    stage: str
    cache: Path
    begun_s: float
    kept_s: float
    kept_cpu_s: float = 0.0
    first_s: float | None = None
    first_cpu_s: float = 0.0
    seen_s: float = 0.0
    cpu_s: float = 0.0
    entries: frozenset[tuple[str, int]] | None = None

    def look(self) -> bool:
        """Read what it has taken and kept; False if it has ended."""
        cpu_s = cpu_seconds(self.pid)
        if cpu_s is None:
            return False
        self.cpu_s, self.seen_s = cpu_s, time.monotonic()
        entries = kept_files(self.cache)
        if self.entries is not None and entries != self.entries:
            if self.first_s is None:
                self.first_s, self.first_cpu_s = self.seen_s - self.begun_s, self.cpu_s
            self.kept_s, self.kept_cpu_s = self.seen_s, self.cpu_s
        self.entries = entries
        return True

    @property
    def lost_s(self) -> float:
        """At most so much is done again: what came after the last view that was kept, and up to the first."""
        whole = self.seen_s - self.begun_s
        return min(whole, self.seen_s - self.kept_s + (self.first_s if self.first_s is not None else 0.0))

    @property
    def lost_cpu_s(self) -> float:
        """The same in processor seconds."""
        return min(self.cpu_s, self.cpu_s - self.kept_cpu_s + self.first_cpu_s)


def kept_files(cache: Path) -> frozenset[tuple[str, int]]:
    """Finished entries of a cache, with their times."""
    found = set()
    for path in (path for path in cache.rglob("*") if "/." not in str(path.relative_to(cache.parent))):
        try:
            found.add((str(path), path.stat().st_mtime_ns if path.is_file() else 0))
        except FileNotFoundError:
            continue
    return frozenset(found)


def cpu_seconds(pid: int) -> float | None:
    """Processor seconds of a process and of the children that it waited for; None if it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else sum(map(int, fields[11:15])) / TICKS


def children(pid: int) -> list[int]:
    """Processes that a process started, whichever of its threads did."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found += map(int, task.read_text().split())
        except OSError:
            continue
    return found


class Run:
    """Snakemake in a project, started as a person starts it.

    Args:
        project: where.

    Attributes:
        problems: what a person would have had to look at.
    """

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
        """What a person types."""
        return [sys.executable, "-m", "hilsplat", "run", "--config", "config/ci.yaml", "--", "--cores", "2"]

    def said(self) -> str:
        """The end of what it printed."""
        return self._log.read_text()[-4000:]

    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    def look(self) -> list[Victim]:
        """The jobs that run now."""
        for pid in children(self.process.pid):
            if pid not in self.jobs and (stage := stage_of(pid)) is not None:
                now = time.monotonic()
                self.jobs[pid] = Victim(
                    pid, stage, self.project.root / "results/.cache" / stage, begun_s=now, kept_s=now
                )
        return [job for job in self.jobs.values() if job.look()]

    def what_runs(self) -> str:
        """The stages that run now."""
        return ", ".join(job.stage for job in self.look()) or "nothing"

    def wait_for_a_job(self, limit_s: float) -> tuple[float, float] | None:
        """Seconds, and processor seconds, until its first job; None if it ends without any."""
        while self.is_running() and time.monotonic() < self.start_s + limit_s:
            if self.look():
                return time.monotonic() - self.start_s, cpu_seconds(self.process.pid) or 0.0
            time.sleep(POLL_S)
        return None

    def watch_for(self, seconds: float) -> None:
        """Let it work, and see what its jobs keep."""
        until = time.monotonic() + seconds
        while self.is_running() and time.monotonic() < until:
            self.look()
            time.sleep(POLL_S)

    def wait(self, limit_s: float = 7200) -> int:
        """Its exit code; jobs that outlive it are a problem."""
        try:
            code = self.process.wait(timeout=limit_s)
        except subprocess.TimeoutExpired:
            self.problems.append(f"it did not end within {limit_s:.0f} s:\n{self.said()}")
            os.killpg(self.process.pid, signal.SIGKILL)
            code = self.process.wait()
        for pid in self._frozen:  # it must not work beside the next run
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        until = time.monotonic() + WAKE_S
        while any(cpu_seconds(pid) is not None for pid in self.jobs) and time.monotonic() < until:
            time.sleep(POLL_S)
        for job in self.jobs.values():
            if is_alive(job.pid) and cpu_seconds(job.pid) is not None:
                self.problems.append(f"{job.stage} (process {job.pid}) outlived its Snakemake")
                os.kill(job.pid, signal.SIGKILL)
        remounted(self.project.root / "results", "rw")
        self._filler.unlink(missing_ok=True)
        return code

    # ---- what hits it: each returns the jobs whose work was lost --------------------------------------

    def kill_snakemake(self, chance: random.Random) -> list[Victim]:
        """As the kernel does when memory ends."""
        victims = self.look()
        self.process.kill()
        return victims

    def kill_all(self, chance: random.Random) -> list[Victim]:
        """As a machine that loses its power, in so far as processes go."""
        victims = self.look()
        os.killpg(self.process.pid, signal.SIGKILL)
        return victims

    def kill_a_job(self, chance: random.Random) -> list[Victim]:
        """The others go on, and the run ends with an error."""
        victims = self.look()
        chosen = chance.sample(victims, min(1, len(victims)))
        for victim in chosen:
            os.kill(victim.pid, signal.SIGKILL)
        return chosen

    def freeze_orphans(self, chance: random.Random) -> list[Victim]:
        """Jobs that sleep when their Snakemake is killed, and wake later."""
        victims = self.look()
        for victim in victims:
            os.kill(victim.pid, signal.SIGSTOP)
        self._frozen = [victim.pid for victim in victims]
        self.process.kill()
        return victims

    def fill_the_disk(self, chance: random.Random) -> list[Victim]:
        """Jobs fail; the disk has room again once the run has ended."""
        with contextlib.suppress(OSError), self._filler.open("wb") as stream:  # jobs write, too
            room = shutil.disk_usage(self._filler.parent).free
            stream.write(bytes(max(0, room - LEFT_KIB * 1024)))
        return []

    def lock_the_disk(self, chance: random.Random) -> list[Victim]:
        """Results become read-only, and writable once the run has ended."""
        for _ in range(40):  # not while a file is being written
            if remounted(self.project.root / "results", "ro"):
                break
            time.sleep(POLL_S)
        return []

    def clean_up_elsewhere(self, chance: random.Random) -> list[Victim]:
        """Another machine of the same name, with other process numbers, cleans up the shared folder."""
        code = "import sys; from hilsplat.base import processes; processes.remove_leftovers(sys.argv[1])"
        command = ["unshare", "--pid", "--fork", "--mount-proc", sys.executable, "-c", code, "results"]
        environment = self.project.environment()
        ended = subprocess.run(
            command, cwd=self.project.root, env=environment, capture_output=True, text=True
        )
        if ended.returncode:
            self.problems.append(f"no clean-up in another process namespace: {ended.stderr}")
        return []

    def run_twice(self, chance: random.Random) -> list[Victim]:
        """A second run in the same project has to refuse, and the first one gets to its end."""
        second = subprocess.run(
            self.command,
            cwd=self.project.root,
            env=self.project.environment(),
            capture_output=True,
            text=True,
            check=False,
        )
        if self.is_running() and (
            second.returncode == 0 or "another hilsplat run" not in second.stdout + second.stderr
        ):
            self.problems.append(f"a second run was not refused:\n{second.stdout}{second.stderr}")
        return []


def remounted(folder: Path, mode: str) -> bool:
    """Make a disk of its own read-only (`ro`) or writable (`rw`); False if there is none, or it is in use."""
    if not folder.is_mount():
        return False
    return (
        subprocess.run(["mount", "-o", f"remount,{mode}", str(folder)], capture_output=True).returncode == 0
    )


def stage_of(pid: int) -> str | None:
    """The subcommand of a job; None for other processes."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return None
    # a job has a log, `hilsplat run` has none
    return words[words.index("--log") + 2] if "hilsplat" in words and "--log" in words else None


@dataclass(frozen=True)
class Fault:
    """Something that happens to a run.

    Attributes:
        name: in words.
        strike: makes it happen.
        kills: whether it counts as a kill.
        needs_disk: whether results must have a disk of their own.
        may_fail: whether the run may end with an error.
        ends_run: whether it ends at once.
    """

    name: str
    strike: Callable[[Run, random.Random], list[Victim]]
    kills: bool = True
    needs_disk: bool = False
    may_fail: bool = True
    ends_run: bool = True


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
