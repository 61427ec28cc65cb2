"""Names that the user gave to nodes: stored with the scene, matched with texts and paths before CLIP."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hilsplat
from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.query.names import FILE, NO_FILE, read_names, tree_digest, write_names
from hilsplat.web.file_changes import StaleFileError
from tests.unit.finished_desk import SCENE


@pytest.fixture
def desk(desk_project) -> Iterator[Path]:
    """The finished desk, without names before and after the test."""
    yield desk_project / SCENE
    (desk_project / SCENE / FILE).unlink(missing_ok=True)


def nodes_by_text(scene) -> dict[str, int]:
    texts = ("mug", "book", "mug > handle", "mug > handle > rim")
    return {text: scene.query(text)[0].node for text in texts}


def name_nodes(desk: Path, names: dict[int, str], version: str = NO_FILE):
    tree = desk / "default/semantic_tree"
    return write_names(desk, tree, names, len(hilsplat.open_scene(desk).tree), version)


def test_a_named_node_is_the_only_answer_with_the_highest_score_and_no_doubt(desk):
    before = hilsplat.open_scene(desk)
    (unknown, *_) = before.query("kanji guide")
    assert unknown.doubts and unknown.name == ""
    book = nodes_by_text(before)["book"]
    first = name_nodes(desk, {book: "Kanji  guide"})
    (hit,) = hilsplat.open_scene(desk).query(" kanji GUIDE ")
    assert (hit.node, hit.name, hit.doubts) == (book, "Kanji guide", ())
    assert hit.score > 0.9999
    name_nodes(desk, {book: "T\u00fcr"}, first.version)
    (hit,) = hilsplat.open_scene(desk).query("tu\u0308r")  # the same letters in decomposed Unicode
    assert (hit.node, hit.doubts) == (book, ())


def test_all_nodes_with_the_name_are_answers_and_a_path_looks_inside_them(desk):
    found = nodes_by_text(hilsplat.open_scene(desk))
    first = name_nodes(desk, {found["book"]: "thing", found["mug"]: "thing"})
    assert {hit.node for hit in hilsplat.open_scene(desk).query("thing")} == {found["book"], found["mug"]}
    name_nodes(desk, {found["book"]: "mug", found["mug > handle"]: "grip"}, first.version)
    scene = hilsplat.open_scene(desk)
    (label,) = scene.query("mug > handle")  # the green label, because the book is called a mug
    assert scene.tree.parent[label.node] == found["book"]
    (grip,) = scene.query("grip")
    assert grip.node == found["mug > handle"]
    (rim,) = scene.query("grip > rim")
    assert rim.node == found["mug > handle > rim"]


def test_names_change_neither_other_texts_nor_evaluation(desk):
    from hilsplat.query.language_scene import LanguageScene
    from hilsplat.scene.finished import FinishedScene

    before = hilsplat.open_scene(desk)
    mug = nodes_by_text(before)["mug"]
    name_nodes(desk, {mug: "book"})
    found = FinishedScene.locate(desk)
    scored = LanguageScene.from_parts(found.parts, found.evaluate_settings())
    np.testing.assert_array_equal(scored.node_margins(["book"]), before.node_margins(["book"]))
    np.testing.assert_array_equal(
        hilsplat.open_scene(desk).node_margins(["mug"]), before.node_margins(["mug"])
    )


def test_names_are_replaced_only_if_the_last_version_was_read(desk):
    first = name_nodes(desk, {0: "mug"})
    second = name_nodes(desk, {0: "cup"}, first.version)
    with pytest.raises(StaleFileError, match="changed since they were read"):
        name_nodes(desk, {0: "glass"}, first.version)
    with pytest.raises(StaleFileError):
        name_nodes(desk, {0: "glass"})
    assert dict(read_names(desk, desk / "default/semantic_tree").of_node) == {0: "cup"}
    assert not name_nodes(desk, {0: " "}, second.version).of_node


def test_names_of_another_tree_are_kept_but_not_used(desk, tmp_path):
    tree = desk / "default/semantic_tree"
    name_nodes(desk, {0: "mug"})
    other = tmp_path / "other"
    shutil.copytree(tree, other)
    (other / "tree.npz").write_bytes((tree / "tree.npz").read_bytes() + b"\0")
    there = read_names(desk, other)
    assert not there.of_node
    write_names(desk, other, {1: "cup"}, 5, there.version)
    assert dict(read_names(desk, tree).of_node) == {0: "mug"}
    assert dict(read_names(desk, other).of_node) == {1: "cup"}


UNUSABLE = ("a > b", "x" * 81, "\x07", "\x1b]0;x\x07", "a\ud800", "a\u202eb")


@pytest.mark.parametrize(
    ("node", "name", "message"),
    [*((0, name, "valid name") for name in UNUSABLE), (99, "mug", "node 99 does")],
)
def test_a_name_that_cannot_be_requested_is_refused(desk, node, name, message):
    with pytest.raises(SettingsError, match=message):
        name_nodes(desk, {node: name})


FORMAT = "hilsplat-names-1"


@pytest.mark.parametrize(
    "content",
    [
        {"format": "hilsplat-names-9", "trees": {}},
        {"trees": {}},
        {"format": FORMAT, "trees": []},
        {"format": FORMAT, "trees": {"DIGEST": ["mug"]}},
        {"format": FORMAT, "trees": {"DIGEST": {"-1": "mug"}}},
        {"format": FORMAT, "trees": {"DIGEST": {"99999": "mug"}}},
        {"format": FORMAT, "trees": {"DIGEST": {"0": 7}}},
        *({"format": FORMAT, "trees": {"DIGEST": {"0": name}}} for name in UNUSABLE),
        ["mug"],
    ],
)
def test_a_damaged_file_is_refused_and_kept(desk, content):
    text = json.dumps(content).replace("DIGEST", tree_digest(desk / "default/semantic_tree"))
    (desk / FILE).write_text(text)
    with pytest.raises(ArtifactError, match=r"names\.json"):
        hilsplat.open_scene(desk)
    assert (desk / FILE).read_text() == text


def test_nodes_similar_to_a_node_are_ranked_by_cosine(desk):
    scene = hilsplat.open_scene(desk)
    found = nodes_by_text(scene)
    likes = scene.like_node(found["mug > handle"])
    green = likes[0]
    assert scene.tree.parent[green.node] == found["book"] and green.route == "like"  # the green label
    cosines = scene.tree.clip @ scene.tree.clip[found["mug > handle"]]
    assert [hit.score for hit in likes] == sorted((float(cosines[hit.node]) for hit in likes), reverse=True)
    assert {hit.level for hit in likes} == {hilsplat.Level.PART} and len(scene.like_node(0, limit=0)) == 0
    with pytest.raises(SettingsError, match="node 99 does not exist"):
        scene.like_node(99)


def test_names_that_change_while_they_are_read_cannot_be_replaced(desk, monkeypatch):
    """The version is that of the names that were read, or an older one."""
    first = name_nodes(desk, {0: "mug"})

    def change(*_):
        monkeypatch.undo()
        name_nodes(desk, {0: "mug", 1: "book"}, first.version)
        return tree_digest(desk / "default/semantic_tree")

    monkeypatch.setattr("hilsplat.query.names.tree_digest", change)
    read = read_names(desk, desk / "default/semantic_tree")
    assert read.of_node == {0: "mug"}
    with pytest.raises(StaleFileError):
        name_nodes(desk, {0: "cup"}, read.version)
