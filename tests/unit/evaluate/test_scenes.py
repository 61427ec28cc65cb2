"""The table over all scenes of a results folder."""

import shutil
from pathlib import Path

import pytest

from hilsplat.base.artifacts import write_json
from hilsplat.base.errors import ArtifactError
from hilsplat.cli.main import app
from hilsplat.evaluate.scenes import COLUMNS
from hilsplat.evaluate.scores import Score, write_scores


def score(method: str, protocol: str, value: float) -> Score:
    place = {"dataset": "rooms", "scene": "one", "variant": "default", "masks": "m", "view": "000.png"}
    return Score(method, f"text {value}", "", "iou", protocol, value, **place)


@pytest.fixture
def results(desk, tmp_path) -> Path:
    """A scene without report and scores, a scored one, and one that has only poses."""
    for name in ("photos/desk", "rooms/one"):
        shutil.copytree(desk, tmp_path / name)
    shutil.copytree(desk / "scene", tmp_path / "rooms/posed/scene")
    one = tmp_path / "rooms/one"
    write_json(one / "gaussians/report.json", {"psnr_db": 21.456, "gaussians": 864})
    of_tree = [score("tree", "lerf/tree-nodes@5", value) for value in (0.5, 0.8)]
    others = [score("field", "lerf/langsplat@2", 0.1), score("tree", "hierarchy/level-auto@6", 0.3)]
    write_scores(one / "default/scores.csv", [*of_tree, *others])
    return tmp_path


def test_each_scene_has_a_row_with_what_its_run_has_computed(results, capsys):
    out = results / "scenes.csv"
    app(["scenes", "--results", str(results), "--out", str(out)], standalone_mode=False)
    lines = [
        ",".join(COLUMNS),
        "photos/desk,5,1,,,2,2,1,",
        "rooms/one,5,1,864,21.46,2,2,1,0.6500",
        "rooms/posed,5,1,,,,,,",
    ]
    assert out.read_text().splitlines() == lines
    printed = capsys.readouterr().out.splitlines()
    assert [line.replace(" ", "")[1:-1].replace("|", ",") for line in printed[2:]] == lines[1:]
    options = ("--results", str(results), "--protocol", "hierarchy/level-auto")
    app(["scenes", "rooms/o*", *options], standalone_mode=False)
    assert capsys.readouterr().out.splitlines()[2:] == [
        "| rooms/one | 5 | 1 | 864 | 21.46 | 2 | 2 | 1 | 0.3000 |"
    ]


def test_a_foreign_file_is_kept_and_a_pattern_without_scenes_is_refused(results):
    out = results / "notes.csv"
    out.write_text("my notes\n")
    with pytest.raises(ArtifactError, match=r"notes\.csv"):
        app(["scenes", "--results", str(results), "--out", str(out)], standalone_mode=False)
    assert out.read_text() == "my notes\n"
    with pytest.raises(ArtifactError, match="no scene with poses that matches 'cellar'"):
        app(["scenes", "cellar", "--results", str(results)], standalone_mode=False)
