"""Pools of processes, and jobs that end with their workflow."""

import errno
import os
import select
import shlex
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from hilsplat.base.errors import HilsplatError
from hilsplat.base.processes import (
    PARENT,
    end_with_workflow,
    host_token,
    in_order,
    in_own_process,
    in_processes,
    num_cores,
)


def square(base: int, number: int) -> tuple[int, int]:
    return base + number**2, os.getpid()


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc has this option")
def test_freed_memory_is_used_again_without_clearing_new_pages():
    code = """
import resource, numpy
from hilsplat.base.processes import keep_freed_memory
keep_freed_memory()
faults = []
for _ in range(3):
    arrays = [numpy.ones(3 << 20, numpy.uint8) for _ in range(20)]
    del arrays
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(faults[-1] - faults[0])"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(found.stdout) < 1000  # 30,000 without the option


@pytest.mark.parametrize("workers", [1, 2])
def test_results_are_in_the_order_of_the_items(workers):
    assert list(in_processes(square, [], workers)) == []
    results = list(in_processes(partial(square, 10), [(3,), (1,), (2,)], workers))
    assert [value for value, _ in results] == [19, 11, 14]
    assert all((pid == os.getpid()) == (workers == 1) for _, pid in results)


JOB = """
import sys, time
from hilsplat.base.processes import end_with_workflow
end_with_workflow()
print("started", flush=True)
time.sleep(60)
"""
WORKFLOW = """
import os, subprocess, sys
from hilsplat.base.processes import parent_variable
job = subprocess.Popen(sys.argv[1], shell=True, stdout=sys.stdout, env=os.environ | parent_variable())
print(job.pid, flush=True)
job.wait()
"""


def ended(stream) -> bool:
    """Return whether each process with the other end of a pipe ended within ten seconds."""
    readable, _, _ = select.select([stream], [], [], 10)
    return bool(readable) and stream.read() == b""


@pytest.mark.parametrize("between", ["exec ", "true; ", "(", "sh -c '(\"$@\"); true' sh "])
def test_a_job_ends_with_the_workflow_that_started_it(between):
    """A shell may be in between, as with an activated environment."""
    command = f"{between}{shlex.join([sys.executable, '-c', JOB])}{')' if between == '(' else ''}"
    workflow = subprocess.Popen([sys.executable, "-c", WORKFLOW, command], stdout=subprocess.PIPE)
    assert workflow.stdout.readline() and workflow.stdout.readline() == b"started\n"
    workflow.kill()
    workflow.wait()
    assert ended(workflow.stdout)


def test_a_job_does_not_start_once_its_workflow_has_ended():
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    environment = {**os.environ, PARENT: f"{host_token()}:{gone.pid}"}
    job = subprocess.run([sys.executable, "-c", JOB], env=environment, capture_output=True, check=False)
    assert job.returncode == 1 and job.stdout == b""


ZOMBIE = """
import os, subprocess, sys, time
from hilsplat.base.processes import parent_variable
job = [sys.executable, "-c", sys.argv[1]]
subprocess.Popen(["sh", "-c", '"$@"; true', "sh", *job], env=os.environ | parent_variable())
"""


def test_a_job_ends_with_a_workflow_that_nobody_awaits():
    """In a container, the process with the id 1 may await no other; the workflow then stays as a zombie."""
    workflow = subprocess.Popen([sys.executable, "-c", ZOMBIE, JOB], stdout=subprocess.PIPE)  # ends at once
    assert workflow.communicate(timeout=15)[0] in (b"", b"started\n")  # awaits it after its jobs have ended


def test_cores_are_those_of_the_quota(monkeypatch):
    cores = len(os.sched_getaffinity(0))
    for text, number in (
        ("max 100000", cores),
        ("100000 100000", 1),
        ("50000 100000", 1),
        ("9900000 100000", cores),
    ):
        monkeypatch.setattr(Path, "read_text", lambda *_, text=text, **__: text)
        assert num_cores() == number


def test_a_job_on_another_machine_of_a_cluster_runs(monkeypatch):
    """Slurm passes the environment on, but the process that it names is on the login node."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    monkeypatch.setenv(PARENT, f"{'0' * 8}:{gone.pid}")
    end_with_workflow()  # would end this process
    assert PARENT not in os.environ


def test_a_command_started_by_a_user_outlives_the_shell():
    script = f"{shlex.join([sys.executable, '-c', JOB])} & echo $!"
    shell = subprocess.Popen(["sh", "-c", script], stdout=subprocess.PIPE)
    lines = {shell.stdout.readline(), shell.stdout.readline()}
    shell.wait()
    (job,) = (int(line) for line in lines - {b"started\n"})
    os.kill(job, signal.SIGTERM)  # fails if it is gone
    assert ended(shell.stdout)


POOL = """
import time
from hilsplat.base.processes import in_processes
if __name__ == "__main__":
    print("started", flush=True)
    for _ in in_processes(time.sleep, [(60,), (60,)], 2):
        pass
"""


def test_the_processes_of_a_pool_end_with_it(tmp_path):
    (tmp_path / "pool.py").write_text(POOL)
    pool = subprocess.Popen([sys.executable, tmp_path / "pool.py"], stdout=subprocess.PIPE)
    assert pool.stdout.readline() == b"started\n"
    children = Path(f"/proc/{pool.pid}/task/{pool.pid}/children")
    deadline = time.monotonic() + 30
    while len(children.read_text().split()) < 3 and time.monotonic() < deadline:  # workers, and a tracker
        time.sleep(0.05)
    time.sleep(1)  # the workers import what they need
    pool.kill()
    pool.wait()
    assert ended(pool.stdout)


def test_a_library_that_ends_its_process_raises_an_error():
    assert in_own_process(sorted, [2, 1]) == [1, 2]
    with pytest.raises(ChildProcessError, match=r"was terminated by a library\nwhy it ended$"):
        in_own_process(exec, "import os; os.write(2, b'why it ended'); os._exit(0)")
    with pytest.raises(ChildProcessError, match=r"abort was terminated"):
        in_own_process(os.abort)
    with pytest.raises(ZeroDivisionError):
        in_own_process(divmod, 1, 0)


def test_under_a_debugger_items_are_computed_in_the_main_thread():
    before = sys.gettrace()
    sys.settrace(lambda *_: None)
    try:
        threads = set(in_order(lambda _: threading.get_ident(), range(3), 2))
    finally:
        sys.settrace(before)
    assert threads == {threading.get_ident()}


def end_by_signal(number: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_machine_without_shared_memory_is_explained(monkeypatch):
    def refuse(*arguments, **options):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("multiprocessing.synchronize.SemLock.__init__", refuse)
    with pytest.raises(HilsplatError, match=r"Read-only file system(.|\n)*/dev/shm"):
        list(in_processes(divmod, [(1, 1), (2, 1)], 2))


def test_a_killed_process_of_a_pool_is_explained():
    with pytest.raises(HilsplatError, match=r"was killed, probably because memory ran out(.|\n)*fewer cores"):
        list(in_processes(end_by_signal, [(1,), (2,)], 2))


def test_a_spawned_process_imports_nothing_from_the_working_folder(tmp_path):
    """As from the command `hilsplat`, which Python starts without -P."""
    (tmp_path / "bin").mkdir()
    script = tmp_path / "bin/hilsplat"
    script.write_text(
        "import hilsplat.cli.main\nfrom hilsplat.base.processes import in_processes\n"
        "if __name__ == '__main__':\n    print(*in_processes(abs, [(-1,), (-2,)], 2))\n"
    )
    for name in ("pickle", "socket", "random", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a file of the user ran')")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.stdout == "1 2\n", done.stderr
