"""A killed stage resumes where it stopped and ends with the bytes of an undisturbed run."""

import json
import re
import shutil
import signal
import time
from pathlib import Path

import pytest

from hilsplat.base.artifacts import provenance_path, read_index
from hilsplat.scene.scene import Scene
from tests.unit.artifact_changes import change_index
from tests.workflow.conftest import SCENE, Project


def finished_entries(cache: Path) -> list[Path]:
    """Return the complete entries of a cache; hidden ones are incomplete."""
    return [file for file in cache.rglob("*.npz") if "/." not in str(file.relative_to(cache.parent))]


ENTRIES = {"masks": 2}
"""Entries of a view in the cache of a stage, if there is more than one: SAM's candidates and the masks."""


def kill_when(project: Project, command: list[str], cache: Path, entries: int) -> None:
    """Start a command and SIGKILL it once its cache holds the given number of finished entries."""
    process = project.start(*command)
    deadline = time.monotonic() + 300
    while process.poll() is None and time.monotonic() < deadline:
        if len(finished_entries(cache)) >= entries:
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.005)
    process.wait(timeout=60)
    assert process.returncode == -signal.SIGKILL, "the stage ended before it could be killed"


@pytest.mark.parametrize(
    ("name", "entries"),
    [("default/masks", 4), ("default/clip", 2), ("default/contributions", 2), ("gaussians.ply", 1)],
)
def test_a_killed_stage_resumes(copy_of_finished: Project, name: str, entries: int) -> None:
    project = copy_of_finished
    path = project.root / SCENE / name
    expected = project.files(path)
    record = json.loads(path.with_name(f"{path.name}.provenance.json").read_text())
    command = list(record["command"])
    if name == "gaussians.ply":
        settings = json.loads(command[command.index("--settings") + 1])
        assert settings["checkpoint_every"] < settings["iterations"], "the fit writes no checkpoint"
    cache = project.root / "results/.cache"
    shutil.rmtree(cache)
    shutil.rmtree(path) if path.is_dir() else path.unlink()

    kill_when(project, command, cache, entries)
    assert not path.exists(), "a killed stage left an output"
    kept = finished_entries(cache)
    assert kept

    resumed = project.run(*command)
    assert project.files(path) == expected
    if path.is_dir():
        assert all(file.exists() for file in kept), "finished views were recomputed"
        views = entries // ENTRIES.get(path.name, 1)
        assert int(re.search(r"from_cache (\d+)", resumed.stderr)[1]) >= views


def test_one_more_view_costs_one_view(copy_of_finished: Project) -> None:
    """When a view is added, masks and CLIP of the other views come from the cache."""
    project = copy_of_finished
    folder = project.root / SCENE
    scene = Scene.load(folder / "scene")
    cache = {stage: project.root / "results/.cache" / stage for stage in ("masks", "clip")}

    def run_with_training_views(views: list[str]) -> dict[str, set[Path]]:
        entries = read_index(folder / "scene")["views"]
        for name, entry in entries.items():
            entry["split"] = "train" if name in views else "test"
        change_index(folder / "scene", views=entries)
        provenance_path(folder / "scene").unlink(missing_ok=True)
        for stage in ("masks", "contributions", "semantic_tree", "clip"):
            shutil.rmtree(folder / "default" / stage)
            record = json.loads((folder / f"default/{stage}.provenance.json").read_text())
            project.run(*record["command"])
        return {stage: set(finished_entries(path)) for stage, path in cache.items()}

    train, added = scene.views("train"), scene.views("test")[0]
    before = {stage: set(finished_entries(path)) for stage, path in cache.items()}
    assert run_with_training_views(train[1:]) == before, "one view fewer computed something"
    after = run_with_training_views([*train, added])
    for stage in cache:
        assert before[stage] < after[stage]
        assert len(after[stage] - before[stage]) == ENTRIES.get(stage, 1), stage
