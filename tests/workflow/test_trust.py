"""Nothing is lost and nothing stale is taken, shown on the quickest job: the views of the tiny scene."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import pytest

from tests.workflow.conftest import SCENE, Project

IMAGES = f"{SCENE}/world/images"


@pytest.fixture(scope="module")
def drawn(project, tmp_path_factory) -> Project:
    """A project in which that job ran."""
    from tests.workflow.conftest import copy_project

    made = copy_project(project, tmp_path_factory.mktemp("drawn") / "project", results=False)
    made.snakemake(IMAGES)
    return made


def with_command(project: Project, script: str) -> str:
    """A PATH on which `hilsplat` is this script."""
    folder = project.root / "stub"
    folder.mkdir(exist_ok=True)
    (folder / "hilsplat").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "hilsplat").chmod(0o755)
    return f"{folder}{os.pathsep}{project.environment()['PATH']}"


def snakemake(project: Project, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = (sys.executable, "-m", "snakemake", "--configfile", "config/ci.yaml", "--cores", "2", *words)
    return project.run(*command, check=False, **environment)


def test_a_job_that_fails_leaves_the_former_output_as_it_was(drawn: Project) -> None:
    before = {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in (drawn.root / IMAGES).iterdir()}
    failed = snakemake(drawn, IMAGES, "--forcerun", IMAGES, PATH=with_command(drawn, "exit 1"))
    assert failed.returncode != 0 and "Error in rule world" in failed.stdout + failed.stderr
    after = {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in (drawn.root / IMAGES).iterdir()}
    assert after == before
    assert drawn.planned(IMAGES) == set()


def damage_file(project: Project) -> None:
    sorted((project.root / IMAGES).glob("*.png"))[0].unlink()


def damage_provenance(project: Project) -> None:
    (project.root / f"{SCENE}/world.provenance.json").write_text("{")


@pytest.mark.parametrize("damage", [damage_file, damage_provenance])
def test_damage_is_made_good_even_without_the_records_of_snakemake(
    drawn: Project, damage: Callable[[Project], None]
) -> None:
    before = drawn.files(IMAGES)
    damage(drawn)
    for record in (drawn.root / ".snakemake/metadata").iterdir():
        record.unlink()
    assert drawn.planned(IMAGES) == {"world"}
    made = snakemake(drawn, IMAGES)
    assert f"{IMAGES} is made again" in made.stdout + made.stderr
    assert drawn.files(IMAGES) == before
    assert drawn.planned(IMAGES) == set()


def test_other_settings_count_even_without_the_records_of_snakemake(drawn: Project) -> None:
    for record in (drawn.root / ".snakemake/metadata").iterdir():
        record.unlink()
    config = drawn.root / "config/config.yaml"
    text = config.read_text()
    try:
        drawn.edit("config/config.yaml", "world: {views: 12,", "world: {views: 13,")
        assert drawn.planned(IMAGES) == {"world"}
        assert drawn.planned(IMAGES, "--rerun-triggers", "mtime") == set()
    finally:
        config.write_text(text)


def test_a_setting_that_cannot_work_is_refused_before_anything_is_touched(drawn: Project) -> None:
    before = drawn.files("results")
    refused = snakemake(drawn, IMAGES, "--forcerun", IMAGES, "--config", "clip={'model': 'models/nope'}")
    assert refused.returncode != 0
    assert "models/nope is missing" in refused.stdout + refused.stderr
    assert drawn.files("results") == before


def test_the_lock_of_a_killed_run_is_lifted_by_the_next(drawn: Project) -> None:
    path = with_command(drawn, "touch started; exec sleep 60")
    words = [sys.executable, "-m", "snakemake", "--configfile", "config/ci.yaml", "--cores", "2"]
    run = subprocess.Popen(
        [*words, IMAGES, "--forcerun", IMAGES],
        cwd=drawn.root,
        env=drawn.environment(PATH=path),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not (drawn.root / "started").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert (drawn.root / "started").exists()
    group = os.getpgid(run.pid)
    run.kill()
    run.wait()
    os.killpg(group, signal.SIGKILL)  # the stand-in for the job does not end with its parent
    before = drawn.files(IMAGES)
    again = snakemake(drawn, IMAGES, "--rerun-incomplete")
    assert again.returncode == 0
    assert f"lifted the lock of a run that was killed (process {run.pid})" in again.stdout + again.stderr
    assert drawn.files(IMAGES) == before
