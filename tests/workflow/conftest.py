"""Whole runs in copies of the project: edits there never touch the checkout."""

import compileall
import fcntl
import hashlib
import os
import py_compile
import shutil
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import pytest

from hilsplat.base.atomic import atomic_path

MODELS = ("models/sam-tiny", "models/clip-tiny")  # the only models of the checkout that tests use
PACKAGES = ("cpusplat", "hilsplat", "hilsplat_world", "snakemake_logger_plugin_hilsplat")
PARTS = ("Snakefile", "rules", "workflow", "profiles", "config", *PACKAGES, *MODELS)
SCENE = Path("results/synthetic/tiny")
RECORDER = Path(__file__).parent / "recorder"
SKIPPED = shutil.ignore_patterns("*.pyc.*", "kernels-*")
"""Bytecode that other tests may be writing, renamed once complete, and what `copy_kernels` copies."""
BY_CONTENTS = py_compile.PycInvalidationMode.CHECKED_HASH


@dataclass(frozen=True)
class Project:
    """A copy of the project in which commands run on the copy's own code.

    Attributes:
        package: folder of the package, if it is not in the copy.
        before: words before each command, such as those of another user.
    """

    root: Path
    package: Path | None = None
    before: tuple[str, ...] = ()

    def run(self, *command: str, check: bool = True, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run a command there and capture its output."""
        how = {"cwd": self.root, "env": self.environment(**environment), "timeout": 1500}
        result = subprocess.run([*self.before, *command], **how, capture_output=True, text=True, check=False)
        if check and result.returncode != 0:
            raise AssertionError(
                f"{command} ended with {result.returncode}:\n{result.stdout}\n{result.stderr}"
            )
        return result

    def start(self, *command: str, output: IO[str] | int = subprocess.DEVNULL) -> subprocess.Popen:
        """Start a command there, in its own process group."""
        where = {"cwd": self.root, "env": self.environment(), "start_new_session": True}
        return subprocess.Popen([*self.before, *command], **where, stdout=output, stderr=output)

    def environment(self, **more: str) -> dict[str, str]:
        """Return the environment variables for running the copy's `hilsplat` and `snakemake`."""
        scripts = sysconfig.get_path("scripts")
        # Importing the commands sets PYTHONSAFEPATH in this process; users start without it.
        inherited = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
        return {
            **inherited,
            "PATH": f"{scripts}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(self.package or self.root),
            "PYTHONDONTWRITEBYTECODE": "1",
            **more,
        }

    def snakemake(
        self, *words: str, config: str = "ci", check: bool = True, **environment: str
    ) -> subprocess.CompletedProcess[str]:
        """Run Snakemake with a configuration of the project."""
        configured = ("--configfile", f"config/{config}.yaml", "--cores", "2")
        return self.run(sys.executable, "-m", "snakemake", *configured, *words, check=check, **environment)

    def hilsplat_run(self, *words: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run `hilsplat run` with the CI configuration."""
        command = [sys.executable, "-m", "hilsplat", "run", "--config", "config/ci.yaml", *words]
        return self.run(*command, check=check)

    def hilsplat(self, *words: str, folder: Path | None = None, **environment: str) -> str:
        """Return the output of a command of this copy, run here or in another folder."""
        environment["PYTHONPATH"] = str(self.root)
        return (
            Project(folder or self.root).run(sys.executable, "-m", "hilsplat", *words, **environment).stdout
        )

    def planned(self, *words: str) -> set[str]:
        """Rules that a dry run would run, except for the summary that follows every other rule."""
        return {
            line.split()[1].rstrip(":")
            for line in self.snakemake("-n", *words).stdout.splitlines()
            if line.startswith(("rule ", "localrule "))
        } - {"all", "efficiency"}

    def edit(self, path: str, old: str, new: str) -> None:
        """Replace a text, which must be present."""
        file = self.root / path
        text = file.read_text()
        assert old in text, f"{old!r} is not in {path}"
        file.write_text(text.replace(old, new))

    def files(self, folder: Path | str) -> dict[str, bytes]:
        """Bytes of a file, or of all files in a folder except for Snakemake's hidden time stamps."""
        base = self.root / folder
        if base.is_file():
            return {"": base.read_bytes()}
        return {
            str(file.relative_to(base)): file.read_bytes()
            for file in sorted(base.rglob("*"))
            if file.is_file() and not file.name.startswith(".")
        }


def copy_project(source: Path, target: Path, *, results: bool) -> Project:
    """Copy the project's own files and, on request, results with Snakemake's records."""
    target.mkdir(parents=True)
    parts = [*PARTS, *(["results", ".snakemake"] if results else [])]
    for part in parts:
        origin = source / part
        if origin.is_dir():
            shutil.copytree(origin, target / part, symlinks=True, ignore=SKIPPED)
        elif origin.exists():
            shutil.copy2(origin, target / part)
    copy_kernels(source, target)
    if not results:  # rows that a user added to the sheet do not belong in tests
        sheet = target / "config/scenes.tsv"
        rows = sheet.read_text().splitlines(keepends=True)
        sheet.write_text("".join(row for row in rows if not row.startswith("photos\t")))
    return Project(target)


def copy_kernels(source: Path, target: Path) -> None:
    """Copy the compiled kernels of numba that a copy of the same modules lacks.

    They remain valid: files keep their times, and numba names folders after the paths of modules.
    """
    for package in PACKAGES:
        caches = (source / package / "__pycache__").glob("kernels-*")
        for cache in sorted(caches, key=lambda folder: folder.stat().st_mtime)[-1:]:
            for folder in {path.parent for path in (source / package).rglob("*.py")}:
                there = (
                    target
                    / cache.relative_to(source)
                    / _folder_of_kernels(target / folder.relative_to(source))
                )
                for file in (cache / _folder_of_kernels(folder)).glob("*.nb[ci]"):
                    if not (there / file.name).exists():
                        there.mkdir(parents=True, exist_ok=True)
                        with atomic_path(there / file.name, durable=False) as temporary:
                            shutil.copy2(file, temporary)


def _folder_of_kernels(modules: Path) -> str:
    return f"{modules.name}_{hashlib.sha1(str(modules).encode()).hexdigest()}"


DECOY = "open(__file__ + '.ran', 'w')\nraise SystemExit('a file of the user ran')\n"
DECOYS = ("numpy.py", "random.py", "yaml.py", "snakemake.py", "hilsplat/__init__.py", "hilsplat/__main__.py")
STRANGER = 54321
AS_STRANGER = (
    *("setpriv", f"--reuid={STRANGER}", f"--regid={STRANGER}", "--clear-groups"),
    *("--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"),  # the checkout may be private
    *("env", "HOME=/nonexistent", "XDG_CACHE_HOME=", "NUMBA_CACHE_DIR=", "MPLCONFIGDIR="),
)
"""Words before a command that run it as a user without a name, a home and a cache."""


def with_decoys(root: Path, package: Path) -> Project:
    """Replace the package in a copy of the project by files named like modules, which must never run."""
    shutil.rmtree(root / "hilsplat")
    for name in DECOYS:
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_text(DECOY)
    return Project(root, package)


def given_to_stranger(project: Project) -> Project:
    """Give a project to the stranger, who runs all commands in it."""
    for path in (project.root, *project.root.rglob("*")):
        os.chown(path, STRANGER, STRANGER, follow_symlinks=False)
    for path in project.root.parents:  # folders of temporary files are private
        if path.stat().st_mode & 0o077 == 0:
            path.chmod(0o711)
    temporary = f"TMPDIR={project.root}"
    return Project(project.root, project.package, (*AS_STRANGER, temporary))


def recorded(project: Project) -> Path:
    """Return the folder in which the processes of `finished` noted what they loaded."""
    folder = project.root / "recorded"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def finished(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A copy in which the CI configuration ran to its end; the processes of a test run share it."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    with (folder / "finished.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the others wait: the run takes every core
        copy = Project(folder / "finished")
        if not (folder / "finished.done").exists():
            shutil.rmtree(copy.root, ignore_errors=True)
            copy_project(project, copy.root, results=False)
            for package in PACKAGES:  # so that no process compiles the package again; edited files still are
                compileall.compile_dir(copy.root / package, quiet=1, invalidation_mode=BY_CONTENTS)
            copy.snakemake(PYTHONPATH=f"{copy.root}{os.pathsep}{RECORDER}", RECORDED=str(recorded(copy)))
            copy_kernels(copy.root, project)
            (folder / "finished.done").touch()
    return copy


@pytest.fixture
def copy_of_finished(finished: Project, tmp_path: Path) -> Project:
    """A fresh copy of the finished run, to edit."""
    return copy_project(finished.root, tmp_path / "project", results=True)


@pytest.fixture
def plain(finished: Project, tmp_path: Path) -> Project:
    """A fresh copy of the project without results, to edit, with the compiled kernels of `finished`."""
    return copy_project(finished.root, tmp_path / "project", results=False)
