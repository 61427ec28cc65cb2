"""Names of nodes from a vocabulary, and doubts about words for absent things."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hilsplat
from hilsplat.base.artifacts import read_index, read_json
from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.embed.clip import open_clip_of
from hilsplat.query.answer import answer
from hilsplat.query.names import write_names
from hilsplat.query.node_names import COMMON, NodeNaming, Vocabulary, named
from hilsplat.query.relevancy import margins
from hilsplat.viewer.payload import described_nodes
from tests.unit.artifact_changes import change_index
from tests.unit.query.test_search_scales import tree_of


@pytest.fixture
def desk(named_desk) -> Path:
    return named_desk


def test_sections_comments_and_repeated_texts_of_a_file(tmp_path):
    path = tmp_path / "words.txt"
    path.write_text(
        "\ufeffmug, red  mug # two\n\n[Parts]\nhandle\nhandle, lid\n[surfaces]\nfloor\n[absent]\nmoon\n"
    )
    assert Vocabulary.read(path) == Vocabulary(("mug", "red mug"), ("handle", "lid"), ("floor",), ("moon",))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"mug\nred, a > b", r"line 2 of .*'a > b' is not a valid name"),
        (b"mug\x1b[2J", "line 1 of .* is not a valid name"),
        (b"[colours]\nred", "line 1 .* unknown section"),
        (b"# nothing", "no texts"),
        (b"\xff", "read"),
    ],
)
def test_invalid_vocabularies_are_refused(tmp_path, content, message):
    (tmp_path / "words.txt").write_bytes(content)
    with pytest.raises(SettingsError, match=message):
        Vocabulary.read(tmp_path / "words.txt")


def test_absent_words_of_the_common_vocabulary_are_not_among_its_names():
    common = Vocabulary.read(COMMON)
    assert len(common.things) > 1000 and len(common.parts) > 300 and len(common.absent) >= 300
    assert not {*common.absent} & {*common.things, *common.parts, *common.surfaces} - {"tank"}


def test_a_name_must_stand_out_and_differ_from_the_name_of_the_parent():
    texts = np.eye(24, dtype=np.float32)
    vocabulary = Vocabulary(
        tuple(f"thing {n}" for n in range(11)), tuple(f"part {n}" for n in range(11)), ("floor", "wall")
    )
    tree = tree_of([1, 1, 1, 2, 2, 2], [-1, -1, -1, 0, 0, 1])
    vague = np.full(24, 0.2, np.float32)
    tree = replace(tree, clip=np.stack([texts[2], texts[22], vague, texts[11], texts[2], texts[12]]))
    generic = np.full((1, 24), 0.01, np.float32)
    rows = named(tree, vocabulary, margins(tree.clip, texts, generic).T)
    assert [row["name"] for row in rows] == ["thing 2", "floor", "", "part 0", "", "part 1"]
    assert [row["surface"] for row in rows] == [False, True, False, False, False, False]
    assert rows[0]["candidates"][0] == ["thing 2", pytest.approx(0.99)] and len(rows[0]["candidates"]) == 5


def test_names_of_parts_include_their_whole_and_user_given_names_come_first(desk):
    scene = hilsplat.open_scene(desk)
    names = ("mug", "book", "handle", "", "rim")
    scene = replace(scene, naming=NodeNaming(names, (False,) * 5, np.eye(3, dtype=np.float32)))
    order = [scene.query(text)[0].node for text in ("mug", "book", "mug > handle", "mug > handle > rim")]
    assert order[:2] == [0, 1] and scene.name_of(order[2]) == "handle of mug"
    assert scene.name_of(order[3]) == "rim of mug"
    named_alike = NodeNaming(("cup", "book", "cupboard", "", "rim of cup"), (False,) * 5, scene.naming.rivals)
    alike = replace(scene, naming=named_alike)
    assert alike.name_of(order[2]) == "cupboard of cup" and alike.name_of(order[3]) == "rim of cup"
    tree = desk / "default/semantic_tree"
    write_names(desk, tree, {0: "pot"}, len(scene.tree), "none")
    renamed = replace(scene, names=hilsplat.open_scene(desk).names)
    assert renamed.name_of(0) == "pot" and renamed.name_of(order[2]) == "handle of pot"
    (desk / "names.json").unlink()


def test_answers_show_the_names_that_the_stage_wrote(desk, tmp_path):
    rows = read_json(desk / "default/names/names.json")
    scene = hilsplat.open_scene(desk)
    assert len(rows) == len(scene.tree) and scene.naming is not None
    (mug,) = scene.query("mug")
    assert rows[mug.node]["candidates"][0][0] == "mug"
    assert mug.name == scene.name_of(mug.node)
    assert "name " in next(answer(desk, "mug", out=tmp_path))


def test_names_of_another_tree_are_not_shown_and_damaged_ones_are_refused(desk, tmp_path):
    tree, clip = desk / "default/semantic_tree", desk / "default/clip"
    assert NodeNaming.load(desk / "default/nothing", tree, clip) is None
    other = tmp_path / "names"
    shutil.copytree(desk / "default/names", other)
    own = read_index(other)["tree_sha256"]
    change_index(other, tree_sha256="another")
    assert NodeNaming.load(other, tree, clip) is None
    whole = read_json(desk / "default/names/names.json")
    hostile = [{**whole[0], "name": "\x1b[2J"}, *whole[1:]]
    for damaged in (hostile, [{"name": "mug"}], whole[:-1], [*whole[:-1], 7], {}):
        (other / "names.json").write_text(json.dumps(damaged))
        change_index(other, tree_sha256=own)
        with pytest.raises(ArtifactError, match=r"names\.json or rivals\.npy is damaged"):
            NodeNaming.load(other, tree, clip)


def test_texts_that_the_model_does_not_know_or_that_match_by_chance_are_doubted(desk):
    scene = hilsplat.open_scene(desk)
    assert open_clip_of(desk / "default/clip").unknown_words("mug zebra, book") == ["zebra"]
    (doubt,) = scene.query("zebra")[0].doubts
    assert str(doubt) == "'zebra' may not be in the scene: the model's vocabulary lacks 'zebra'"
    assert scene.query("mug > handle")[0].doubts == ()
    scene = hilsplat.open_scene(desk)
    blue, white = np.array([[0, 0, 1.0]], np.float32), np.full((1, 3), 3**-0.5, np.float32)
    rivals = np.concatenate([np.repeat(blue, 30, axis=0), np.repeat(white, 70, axis=0)])
    scene = replace(scene, naming=replace(scene.naming, rivals=rivals), _rival_margins={})
    (doubt,) = scene.query("book", "whole")[0].doubts  # a third of the words finds the book as well
    assert doubt.chance == pytest.approx(31 / 101)
    assert str(doubt) == "'book' may not be in the scene: 31% of words for absent things score as high"


def test_names_are_hidden_where_the_model_does_not_know_what_it_sees(desk, monkeypatch):
    monkeypatch.setattr("hilsplat.query.language_scene.caution_of", lambda clip, scene: "meaningless")
    scene = hilsplat.open_scene(desk)
    assert not any(hit.name for hit in scene.query("mug"))
    assert {node["called"] for node in described_nodes(scene)["nodes"]} == {""}
    assert scene.query("unicorn")[0].doubts  # doubts need the words for absent things, not the names
