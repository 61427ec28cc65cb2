"""`hilsplat run` repairs damage and recovers from kills, shown on the quickest jobs of the tiny scene."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.workflow.conftest import SCENE, Project, copy_project

IMAGES = f"{SCENE}/world/images"
RUN = ("-m", "hilsplat", "run", "--config", "config/ci.yaml")
SNAKEMAKE = ("-m", "snakemake", "--configfile", "config/ci.yaml", "--cores", "2")


@pytest.fixture(scope="module")
def drawn(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A project in which the views of the tiny scene are rendered."""
    made = copy_project(project, tmp_path_factory.mktemp("drawn") / "project", results=False)
    made.hilsplat_run(IMAGES)
    return made


def forget(project: Project) -> None:
    """Remove Snakemake's own records."""
    for record in (project.root / ".snakemake/metadata").iterdir():
        record.unlink()


def damage_file(project: Project) -> None:
    sorted((project.root / IMAGES).glob("*.png"))[0].unlink()


def damage_provenance(project: Project) -> None:
    (project.root / f"{SCENE}/world.provenance.json").write_text("{")


@pytest.mark.parametrize("damage", [damage_file, damage_provenance])
def test_damage_is_repaired_even_without_snakemakes_records(
    drawn: Project, damage: Callable[[Project], None]
) -> None:
    before = drawn.files(IMAGES)
    damage(drawn)
    forget(drawn)
    found = drawn.run(sys.executable, "-m", "hilsplat", "verify", check=False)
    assert f"snakemake --cores 2 --forcerun {IMAGES}" in found.stdout
    made = drawn.hilsplat_run(IMAGES)
    assert f"{IMAGES} is rebuilt" in made.stderr
    assert drawn.files(IMAGES) == before
    assert "Nothing to be done" in drawn.hilsplat_run(IMAGES).stderr


def test_other_settings_count_even_without_snakemakes_records(drawn: Project) -> None:
    forget(drawn)
    config = drawn.root / "config/config.yaml"
    text = config.read_text()
    try:
        drawn.edit("config/config.yaml", "world: {views: 12,", "world: {views: 13,")
        assert "rule world:" in drawn.hilsplat_run(IMAGES, "--", "-n").stdout
    finally:
        config.write_text(text)


def test_an_unusable_setting_is_refused_before_any_job(drawn: Project) -> None:
    before = drawn.files("results")
    for start in (drawn.hilsplat_run, drawn.snakemake):
        separator = ["--"] if start == drawn.hilsplat_run else []
        words = [*separator, "--forcerun", IMAGES, "--config", "clip={'model': 'models/nope'}"]
        refused = start(IMAGES, *words, check=False)
        assert refused.returncode != 0
        assert "models/nope is missing" in refused.stdout + refused.stderr
    assert drawn.files("results") == before


@contextmanager
def job_of(project: Project, log: str, *words: str, freeze: bool = False) -> Iterator[subprocess.Popen]:
    """Start a run, and yield its process, perhaps frozen, once the log of its job exists."""
    (project.root / log).unlink(missing_ok=True)
    process = project.start(sys.executable, *words)
    deadline = time.monotonic() + 120
    while not (project.root / log).exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    if freeze:
        os.killpg(process.pid, signal.SIGSTOP)
    assert (project.root / log).exists() and process.poll() is None, "the job did not start"
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_the_next_run_recovers_from_a_kill(drawn: Project) -> None:
    before = drawn.files(IMAGES)
    log = f"{SCENE}/logs/world.log"
    with job_of(drawn, log, *RUN, IMAGES, "--", "--forcerun", IMAGES, freeze=True) as run:
        refused = drawn.hilsplat_run(IMAGES, check=False)
        assert refused.returncode == 1 and "another hilsplat run" in refused.stderr
        run.kill()
        run.wait()
        drawn.hilsplat_run(IMAGES)
    assert drawn.files(IMAGES) == before
    assert not list((drawn.root / "results").rglob(".writing-*"))
    assert "Nothing to be done" in drawn.hilsplat_run(IMAGES).stderr


def test_the_locks_of_a_live_run_are_never_removed(copy_of_finished: Project) -> None:
    """A runs; B, plain Snakemake, runs other targets; A is killed; C starts."""
    project, default = copy_of_finished, f"{SCENE}/default"
    masks = "results/figures/synthetic/tiny/masks.png"
    locks = project.root / ".snakemake/locks"
    clip = [*RUN, f"{default}/clip", "--", "--forcerun", f"{default}/clip"]
    plain = [*SNAKEMAKE, masks, "--forcerun", masks]
    with (
        job_of(project, f"{default}/logs/clip.log", *clip, freeze=True) as a,
        job_of(project, "results/figures/synthetic/tiny/masks.log", *plain, freeze=True) as b,
    ):
        held = {path.name: path.read_bytes() for path in locks.iterdir() if b"masks.png" in path.read_bytes()}
        assert held
        a.kill()
        a.wait()
        refused = project.hilsplat_run(f"{default}/coverage_tree", check=False)
        assert refused.returncode == 1 and "another Snakemake process is running" in refused.stderr
        left = {path.name: path.read_bytes() for path in locks.iterdir()}
        assert held.items() <= left.items()
        os.killpg(b.pid, signal.SIGCONT)
        assert b.wait(timeout=300) == 0
    project.hilsplat_run(f"{default}/clip")
