"""One query of many finished scenes: copies of the desk whose scores differ by their settings."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import hilsplat
from hilsplat.base.artifacts import read_json
from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.base.lineage import read_provenance
from hilsplat.cli.main import app
from hilsplat.query.names import write_names
from hilsplat.query.scenes import Scenes, report_of
from tests.unit.artifact_changes import write_record

SCENES = 8


@pytest.fixture(scope="module")
def results(named_desk, tmp_path_factory) -> Path:
    """Results of eight scenes in two data sets, with scores that grow with the number of the scene."""
    project = tmp_path_factory.mktemp("many")
    shutil.copytree(named_desk.parents[2] / "models", project / "models")
    for number in range(SCENES):
        copy = project / "results" / ("photos", "rooms")[number % 2] / f"desk-{number}"
        shutil.copytree(named_desk, copy)
        settings = {"relevancy_scale": 5.0 + 6 * number}
        write_record(copy / "default/scores.csv", settings={"evaluate": settings})
    return project / "results"


@pytest.fixture(scope="module")
def opened(results) -> dict[str, hilsplat.LanguageScene]:
    """Each scene, opened alone."""
    folders = results.glob("*/desk-*")
    return {f"{folder.parent.name}/{folder.name}": hilsplat.open_scene(folder) for folder in folders}


@pytest.fixture
def changed(results, tmp_path) -> Path:
    """A scene to change in a copy of the results of three scenes, beside the models."""
    shutil.copytree(results.parent / "models", tmp_path / "models")
    for name in ("photos/desk-6", "photos/desk-4", "rooms/desk-7"):
        shutil.copytree(results / name, tmp_path / "results" / name)
    return tmp_path / "results/rooms/desk-7"


@pytest.mark.parametrize(
    ("text", "level"), [("mug", "auto"), ("handle", "part"), ("book", "subpart"), ("mug > handle", "auto")]
)
def test_answers_are_those_of_each_scene_alone_best_scene_first(results, opened, text, level):
    scenes = hilsplat.open_scenes(results)
    hits = scenes.query(text, level, limit=SCENES, each=2)
    assert all(len(repr(each)) < 100 for each in (scenes, *scenes.found, *hits))
    alone = {name: scene.query(text, level, limit=2) for name, scene in opened.items()}
    assert len(alone) == SCENES and sum(map(len, alone.values())) == len(hits)
    best = sorted(alone, key=lambda name: (-alone[name][0].score, name))
    expected = [(name, hit) for name in best for hit in alone[name]]
    for found, (name, hit) in zip(hits, expected, strict=True):
        assert (found.scene, found.node, found.level, found.name) == (name, hit.node, hit.level, hit.name)
        assert (found.score, found.route, found.doubts) == (hit.score, hit.route, hit.doubts)
        assert (found.gaussians, found.centroid) == (len(hit.gaussians), hit.centroid)
        assert found.size == hit.oriented_box.size
        assert found.picture.is_file() and found.picture.name == hit.best_views[0]


def test_a_pattern_a_limit_and_a_threshold_restrict_the_answers_of_a_small_index(results):
    rooms = hilsplat.open_scenes(results, "rooms")  # a data set
    assert str(rooms.found) == str(hilsplat.open_scenes(results, "rooms/*").found)
    assert {hit.scene.partition("/")[0] for hit in rooms.query("mug", limit=SCENES)} == {"rooms"}
    assert len(rooms.query("mug", limit=3)) == 3
    assert [found.name for found in hilsplat.open_scenes(results, "desk-3").found] == ["rooms/desk-3"]
    high = rooms.query("mug", threshold=0.99, limit=SCENES)
    assert high and len(high) < SCENES // 2 and min(hit.score for hit in high) >= 0.99
    with pytest.raises(SettingsError, match="level 'piece' is unknown"):
        rooms.query("mug", "piece")
    for name in ("limit", "each"):
        with pytest.raises(SettingsError, match=f"{name} is -1"):
            rooms.query("mug", **{name: -1})
    with pytest.raises(ArtifactError, match="has no finished scene that matches 'cellar'"):
        hilsplat.open_scenes(results, "cellar")
    names = results / "rooms/desk-7/default/names"
    record = read_provenance(names)
    assert record is not None and "nodes.safetensors" in record.outputs["names"].bytes
    nodes, vector_bytes = len(read_json(names / "names.json")), 4 * 3
    assert (names / "nodes.safetensors").stat().st_size < nodes * (vector_bytes + 200) + 3000


INDEX, OTHER = "default/names/nodes.safetensors", {"sha256": "another", "bytes": {}}
CHANGES = {
    "deletion": shutil.rmtree,
    "masks being rebuilt": lambda scene: shutil.rmtree(scene / "default/masks"),
    "other masks": lambda scene: write_record(scene / "default/masks", outputs={"masks": OTHER}),
    "other Gaussians": lambda scene: write_record(scene / "gaussians.ply", outputs={"gaussians.ply": OTHER}),
    "lost index": lambda scene: (scene / INDEX).unlink(),
    "other tree": lambda scene: (scene / "default/semantic_tree/tree.npz").write_bytes(b"0"),
    "damaged index": lambda scene: (scene / INDEX).write_bytes(b"nothing"),
}
BEFORE = ("deletion", "masks being rebuilt", "other masks", "other Gaussians", "lost index")
AFTER = ("deletion", "lost index", "other tree", "damaged index")


@pytest.mark.parametrize(
    ("change", "after"), [*((each, False) for each in BEFORE), *((each, True) for each in AFTER)]
)
def test_a_scene_changed_before_or_after_opening_does_not_answer(changed, change, after):
    scenes = hilsplat.open_scenes(changed.parents[1])
    if not after:
        assert scenes.query("mug")[0].scene == "rooms/desk-7"
    CHANGES[change](changed)
    scenes = scenes if after else hilsplat.open_scenes(changed.parents[1])
    assert [hit.scene for hit in scenes.query("mug", limit=2)] == ["photos/desk-6", "photos/desk-4"]
    assert [*scenes.skipped] == (["rooms/desk-7"] if after or changed.exists() else [])


def test_scenes_opened_by_a_relative_path_do_not_follow_the_working_folder(changed, tmp_path, monkeypatch):
    monkeypatch.chdir(changed.parents[2])
    scenes = hilsplat.open_scenes()
    monkeypatch.chdir(tmp_path.parent)
    (hit, *_) = scenes.query("mug")
    assert hit.picture.is_file() and hilsplat.open_scene(hit.folder).query("mug")[0].node == hit.node


def test_a_name_given_by_hand_is_found_first_and_the_next_command_repeats_the_query(changed):
    scene = changed.parents[1] / "photos/desk-4"
    tree = scene / "default/semantic_tree"
    write_names(scene, tree, {2: "my mug"}, 5, hilsplat.open_scene(scene).names.version)
    (first, *_) = hilsplat.open_scenes(changed.parents[1]).query("My mug")
    assert (first.scene, first.node, first.name, first.doubts) == ("photos/desk-4", 2, "my mug", ())
    scenes = hilsplat.open_scenes(changed.parents[1])
    of_paper = [replace(scene, finished=replace(scene.finished, variant="paper")) for scene in scenes.found]
    report = report_of(Scenes(tuple(of_paper), {}), "mug", scenes.query("mug", limit=1), "part")
    assert report.splitlines()[-1].endswith(" mug --level part --variant paper")


def test_the_command_prints_a_table_or_json(changed, capsys):
    shutil.rmtree(changed / "default/semantic_tree")
    place = ("--results", str(changed.parents[1]))
    app(["query", "--all", "mug", *place], standalone_mode=False)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "2 answers to 'mug' in 2 scenes"
    assert lines[2].split()[1:5] == ["photos/desk-6", "0", "whole", "mug"]
    assert lines[4] == f"more about the best: hilsplat query {changed.parents[1] / 'photos/desk-6'} mug"
    assert lines[5].startswith("rooms/desk-7 is skipped: ")
    app(["query", "--all", "*-4", "unicorn", "--json", *place], standalone_mode=False)
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["scene"], row["level"]) == ("photos/desk-4", "whole")
    assert row["doubts"] == ["'unicorn' may not be in the scene: the model's vocabulary lacks 'unicorn'"]
    with pytest.raises(SettingsError, match="there is no text to search for in desk-4"):
        app(["query", "desk-4", *place], standalone_mode=False)
    with pytest.raises(ArtifactError, match=r"mug is missing(.|\n)*photos/desk-4"):
        app(["query", "mug", *place], standalone_mode=False)
