"""The table over all scenes of a results folder."""

import os
import shutil
import time
from pathlib import Path

import pytest

from hilsplat.base.artifacts import write_json
from hilsplat.base.errors import ArtifactError
from hilsplat.cli.main import app
from hilsplat.evaluate.scenes import COLUMNS
from hilsplat.evaluate.scores import write_scores
from hilsplat.query.scene_state import SceneState
from tests.unit.evaluate.builders import score


@pytest.fixture
def results(desk, tmp_path) -> Path:
    """A scene without report and scores, a scored one, one with key views, and one that has only poses."""
    for name in ("photos/desk", "rooms/one"):
        shutil.copytree(desk, tmp_path / name)
    one = tmp_path / "rooms/one"
    write_json(one / "gaussians/report.json", {"psnr_db": 21.456, "gaussians": 864})
    scores = [("lerf/tree-nodes@6", 0.5), ("lerf/tree-nodes@6", 0.8), ("lerf/langsplat@3 (wholes)", 0.2)]
    of_tree = [
        score("iou", value, method="tree", query=f"text {value}", protocol=name) for name, value in scores
    ]
    of_field = score("iou", 0.1, method="field", protocol="lerf/tree-nodes@6")
    write_scores(one / "default/scores.csv", [*of_tree, of_field])
    for part in ("clip", "semantic_tree", "masks"):
        shutil.copytree(desk / "default" / part, tmp_path / "rooms/early/key-views" / part)
    for name in ("early", "posed"):
        shutil.copytree(desk / "scene", tmp_path / "rooms" / name / "scene")
    (tmp_path / "figures/rooms/one").mkdir(parents=True)
    for record in tmp_path.rglob("*.provenance.json"):
        os.utime(record, (0, 86400 * 365))
    return tmp_path


def test_each_scene_has_a_row_with_what_its_run_has_computed(results, capsys):
    out = results / "scenes.csv"
    app(["scenes", "--results", str(results), "--out", str(out)], standalone_mode=False)
    header, *lines = out.read_text().splitlines()
    assert header == ",".join(COLUMNS)
    date = time.strftime("%Y-%m-%d %H:%M", time.localtime(86400 * 365))
    models = '"graph, colours"'
    assert lines == [
        f'photos/desk,"tree, field",5,1,,,2,2,1,,0,{date},{models}',
        f"rooms/early,tree of key views,5,1,,,2,2,1,,0,,{models}",
        f'rooms/one,"tree, field",5,1,864,21.46,2,2,1,0.6500,0,{date},{models}',
        "rooms/posed,poses,5,1,,,,,,,0,,",
    ]
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split() == ["scene", "state", "views", "PSNR", "mIoU", "MB", "date", "models"]
    assert printed[3].split()[:6] == ["rooms/one", "tree,", "field", "6", "21.46", "0.6500"]
    assert printed[3].endswith(f"{date}  graph, colours")
    write_json(
        results / "rooms/one/gaussians/report.json", {"psnr_db": 33.4, "gaussians": 864, "split": "train"}
    )
    app(["scenes", "rooms/one", "--results", str(results)], standalone_mode=False)
    assert "33.40 (training)" in capsys.readouterr().out
    write_json(results / "rooms/one/gaussians/report.json", {"psnr_db": 21.456, "gaussians": 864})
    scores = results / "rooms/one/default/scores.csv"  # of an earlier release
    scores.write_text(scores.read_text().replace("lerf/tree-nodes@6", "lerf/tree-nodes@5"))
    app(["scenes", "rooms/o*", "--results", str(results)], standalone_mode=False)
    assert capsys.readouterr().out.splitlines()[1].split()[:6] == [*printed[3].split()[:5], "0"]


@pytest.mark.parametrize("file", ["gaussians/report.json", "default/scores.csv", "scene/index.json"])
def test_a_damaged_scene_is_named_and_the_others_are_listed(results, capsys, file):
    path, out = results / "rooms/one" / file, results / "scenes.csv"
    path.write_bytes(path.read_bytes()[:20])
    app(["scenes", "--results", str(results), "--out", str(out)], standalone_mode=False)
    states = [line.split(",")[:2] for line in out.read_text().splitlines()[1:]]
    assert states[2] == ["rooms/one", "damaged"] and states[3] == ["rooms/posed", "poses"]
    printed = capsys.readouterr()
    assert printed.out.splitlines()[3].split() == ["rooms/one", "damaged"]
    assert printed.err.startswith(f"rooms/one: {path}") and "fix  " in printed.err


def test_the_size_of_a_scene_is_that_of_its_files(results):
    (results / "rooms/posed/scene/large.bin").write_bytes(b"x" * 2_600_000)
    scene = sum(path.stat().st_size for path in (results / "rooms/early/scene").rglob("*") if path.is_file())
    assert SceneState.read(results / "rooms/posed").num_bytes // 1_000 == 2_600 + scene // 1_000


def test_a_foreign_file_is_kept_and_a_pattern_without_scenes_is_refused(results):
    out = results / "notes.csv"
    out.write_text("my notes\n")
    with pytest.raises(ArtifactError, match=r"notes\.csv"):
        app(["scenes", "--results", str(results), "--out", str(out)], standalone_mode=False)
    assert out.read_text() == "my notes\n"
    with pytest.raises(ArtifactError, match=r"no scene that matches 'dask'(.|\n)*did you mean 'photos/desk'"):
        app(["scenes", "dask", "--results", str(results)], standalone_mode=False)
    with pytest.raises(ArtifactError, match=r"no scene that matches '\*'(.|\n)*hilsplat run"):
        app(["scenes", "--results", str(results / "figures")], standalone_mode=False)
