"""`hilsplat run` repairs damage and recovers from kills, shown on the quickest jobs of the tiny scene."""

import os
import signal
import sys
import time
from collections.abc import Callable

import pytest

from tests.workflow.conftest import SCENE, Project, copy_project

IMAGES = f"{SCENE}/world/images"
RUN = (sys.executable, "-m", "hilsplat", "run", "--config", "config/ci.yaml")


@pytest.fixture(scope="module")
def drawn(finished: Project, tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A project in which the views of the tiny scene are rendered."""
    made = copy_project(finished.root, tmp_path_factory.mktemp("drawn") / "project", results=False)
    made.hilsplat_run(IMAGES)
    return made


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
    for record in (drawn.root / ".snakemake/metadata").iterdir():
        record.unlink()
    found = drawn.run(sys.executable, "-m", "hilsplat", "verify", check=False)
    assert f"snakemake --cores 2 --forcerun {IMAGES}" in found.stdout
    made = drawn.hilsplat_run(IMAGES)
    assert f"rebuilding {IMAGES}: " in made.stderr
    assert drawn.files(IMAGES) == before
    assert "Nothing to be done" in drawn.hilsplat_run(IMAGES).stderr


def test_an_unusable_setting_is_refused_before_any_job(drawn: Project) -> None:
    before = drawn.files("results")
    for start in (drawn.hilsplat_run, drawn.snakemake):
        separator = ["--"] if start == drawn.hilsplat_run else []
        words = [*separator, "--forcerun", IMAGES, "--config", "clip={'model': 'models/nope'}"]
        refused = start(IMAGES, *words, check=False)
        assert refused.returncode != 0 and "Traceback" not in refused.stderr
        assert "models/nope is missing" in refused.stdout + refused.stderr
    assert drawn.files("results") == before


def test_the_next_run_recovers_from_a_kill(drawn: Project) -> None:
    before, log = drawn.files(IMAGES), drawn.root / f"{SCENE}/logs/world.log"
    log.unlink()
    run = drawn.start(*RUN, IMAGES, "--", "--forcerun", IMAGES)
    deadline = time.monotonic() + 120
    while not log.exists() and run.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(run.pid, signal.SIGSTOP)
    try:
        assert log.exists(), "the job did not start"
        refused = drawn.hilsplat_run(IMAGES, check=False)
        assert refused.returncode == 1 and "another hilsplat run" in refused.stderr
    finally:
        run.kill()
        run.wait()
    drawn.hilsplat_run(IMAGES)
    assert drawn.files(IMAGES) == before
    assert not list((drawn.root / "results").rglob(".writing-*"))
    assert "Nothing to be done" in drawn.hilsplat_run(IMAGES).stderr
