"""The pipeline from Python gives the bytes of the workflow, and the example of its page runs."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import hilsplat
from hilsplat.base.lineage import read_provenance
from hilsplat.segment.digests import digest_of, digests_in
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.splat.ply import save_ply
from tests.workflow.conftest import SCENE, Project


def settings_of(artifact: Path, section: str) -> dict:
    """The settings that the workflow recorded for an artifact."""
    return read_provenance(artifact).settings[section]


def test_each_step_gives_the_bytes_of_the_workflow_on_one_core(finished: Project, tmp_path: Path) -> None:
    folder = finished.root / SCENE
    own = folder / "default"
    poses = settings_of(folder / "scene", "poses") | {"camera_model": "simple_pinhole"}  # the option --render
    scene = hilsplat.reconstruct(folder / "world/images", seed=0, threads=1, **poses)
    expected = hilsplat.load_scene(folder)
    for name in ("cam_from_world", "K", "size_hw"):
        ours, theirs = getattr(scene.cameras, name), getattr(expected.cameras, name)
        np.testing.assert_array_equal(ours, theirs, err_msg=name)
    np.testing.assert_array_equal(scene.points_xyz, expected.points_xyz)
    assert scene.split == expected.split
    gaussians = hilsplat.fit(scene, threads=1, **settings_of(folder / "gaussians.ply", "gaussians"))
    save_ply(tmp_path / "gaussians.ply", gaussians)
    assert (tmp_path / "gaussians.ply").read_bytes() == (folder / "gaussians.ply").read_bytes()
    cache = tmp_path / "cache"
    masks = hilsplat.segment(scene, cache=cache, threads=1, **settings_of(own / "masks", "masks"))
    assert {view: digest_of(of_view) for view, of_view in masks.items()} == digests_in(own / "masks")
    linking, model = settings_of(own / "semantic_tree", "semantic_tree"), "models/clip-tiny"
    tree = hilsplat.link(scene, gaussians, masks, model=model, cache=cache, threads=1, **linking).tree
    for name, values in vars(SemanticTree.load(own / "semantic_tree")).items():
        if name != "clip":  # the stage's tree has no vectors
            np.testing.assert_array_equal(getattr(tree, name), values, err_msg=name)


def test_the_example_of_the_page_runs(
    finished: Project, project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    shutil.copytree(finished.root / SCENE / "world/images", tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    example = re.findall(r"```python\n(.*?)```", (project / "docs/python.md").read_text(), re.DOTALL)[0]
    assert example.count("iterations=2000") == 1
    names: dict = {}
    exec(compile(example.replace("iterations=2000", "iterations=200"), "docs/python.md", "exec"), names)
    printed = capsys.readouterr().out
    assert "Scene(photos/desk: 12 views" in printed and "Scores(lerf/langsplat@3 (masks of files)" in printed
    assert Path("answer.png").is_file() and names["rendering"].depth.shape == (300, 400)
    assert hilsplat.open_scene("results/photos/desk").query("car")
