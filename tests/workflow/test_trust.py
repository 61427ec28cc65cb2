"""`hilsplat run` repairs damage and recovers from kills, shown on the quickest jobs of the tiny scene."""

import os
import re
import shlex
import signal
import sys
import time

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


def test_damage_is_repaired_even_without_snakemakes_records(drawn: Project) -> None:
    before = drawn.files(IMAGES)
    (drawn.root / f"{SCENE}/world/images.provenance.json").write_text("{")
    for record in (drawn.root / ".snakemake/metadata").iterdir():
        record.unlink()
    found = drawn.run(sys.executable, "-m", "hilsplat", "verify", check=False)
    assert (
        "to rebuild them, in the project that made them: hilsplat run --config config/ci.yaml" in found.stdout
    )
    made = drawn.hilsplat_run(IMAGES)
    assert f"rebuilding {IMAGES}: " in made.stderr
    assert drawn.files(IMAGES) == before
    assert "Nothing to be done" in drawn.hilsplat_run(IMAGES).stderr


def test_a_decayed_file_is_repaired_by_the_advice_of_the_stage_that_reads_it(drawn: Project) -> None:
    """A bit that the disk lost changes neither the size nor the time of a file."""
    before, path = drawn.files(IMAGES), sorted((drawn.root / IMAGES).glob("*.png"))[0]
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=times)
    assert "Nothing to be done" in drawn.hilsplat_run(IMAGES).stderr
    refused = drawn.hilsplat_run(f"{SCENE}/scene", check=False)
    said = refused.stdout + refused.stderr
    assert refused.returncode != 0 and f"{IMAGES} was changed after it was written" in said
    (command,) = set(re.findall(rf"fix +(hilsplat run .*{IMAGES})$", said, re.MULTILINE))
    drawn.run(sys.executable, "-m", *shlex.split(command))
    assert drawn.files(IMAGES) == before


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
