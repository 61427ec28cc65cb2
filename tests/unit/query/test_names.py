"""Names that a person gave to nodes: kept with the scene, answering texts and paths before CLIP."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import hilsplat
from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.query.names import FILE, NO_FILE, StaleNamesError, read_names, tree_digest, write_names
from tests.unit.finished_desk import SCENE, build_finished_desk


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    return build_finished_desk(tmp_path_factory.mktemp("project"))


@pytest.fixture
def desk(built) -> Path:
    """The finished desk, without names."""
    (built / SCENE / FILE).unlink(missing_ok=True)
    return built / SCENE


def nodes_by_text(scene) -> dict[str, int]:
    texts = ("mug", "book", "mug > handle", "mug > handle > rim")
    return {text: scene.query(text)[0].node for text in texts}


def name_nodes(desk: Path, names: dict[int, str], version: str = NO_FILE):
    tree = desk / "default/semantic_tree"
    return write_names(desk, tree, names, len(hilsplat.open(desk).tree), version)


def test_a_name_answers_alone_with_the_highest_score_and_without_doubt(desk):
    before = hilsplat.open(desk)
    (unknown, *_) = before.query("kanji guide")
    assert unknown.doubts and unknown.name == ""
    book = nodes_by_text(before)["book"]
    name_nodes(desk, {book: "Kanji  guide"})
    (hit,) = hilsplat.open(desk).query(" kanji GUIDE ")
    assert (hit.node, hit.name, hit.doubts) == (book, "Kanji guide", ())
    assert hit.score > 0.9999


def test_a_name_in_a_path_decides_what_the_parts_belong_to(desk):
    found = nodes_by_text(hilsplat.open(desk))
    name_nodes(desk, {found["book"]: "mug", found["mug > handle"]: "grip"})
    scene = hilsplat.open(desk)
    (label,) = scene.query("mug > handle")  # the green label, because the book is called a mug
    assert scene.tree.parent[label.node] == found["book"]
    (grip,) = scene.query("grip")
    assert grip.node == found["mug > handle"]
    (rim,) = scene.query("grip > rim")
    assert rim.node == found["mug > handle > rim"]


def test_nodes_with_one_name_answer_together(desk):
    found = nodes_by_text(hilsplat.open(desk))
    name_nodes(desk, {found["book"]: "thing", found["mug"]: "thing"})
    assert {hit.node for hit in hilsplat.open(desk).query("thing")} == {found["book"], found["mug"]}


def test_other_texts_and_evaluation_do_not_know_the_names(desk):
    from hilsplat.query.language_scene import LanguageScene
    from hilsplat.scene.finished import FinishedScene

    before = hilsplat.open(desk)
    mug = nodes_by_text(before)["mug"]
    name_nodes(desk, {mug: "book"})
    found = FinishedScene.locate(desk)
    scored = LanguageScene.from_parts(found.parts, found.evaluate_settings())
    np.testing.assert_array_equal(scored.node_margins(["book"]), before.node_margins(["book"]))
    np.testing.assert_array_equal(hilsplat.open(desk).node_margins(["mug"]), before.node_margins(["mug"]))


def test_a_change_must_know_the_version_that_it_changes(desk):
    first = name_nodes(desk, {0: "mug"})
    second = name_nodes(desk, {0: "cup"}, first.version)
    with pytest.raises(StaleNamesError, match="changed since they were read"):
        name_nodes(desk, {0: "glass"}, first.version)
    with pytest.raises(StaleNamesError):
        name_nodes(desk, {0: "glass"})
    assert dict(read_names(desk, desk / "default/semantic_tree").of_node) == {0: "cup"}
    assert not name_nodes(desk, {0: " "}, second.version).of_node


def test_names_of_another_tree_wait_until_it_is_back(desk, tmp_path):
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


@pytest.mark.parametrize(
    ("node", "name", "message"),
    [
        (0, "a > b", "be a name"),
        (0, "x" * 81, "be a name"),
        (0, "\x07", "be a name"),
        (99, "mug", "no node 99"),
    ],
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
        {"format": FORMAT},
        {"format": FORMAT, "trees": []},
        {"format": FORMAT, "trees": {"DIGEST": ["mug"]}},
        {"format": FORMAT, "trees": {"DIGEST": {"first": "mug"}}},
        {"format": FORMAT, "trees": {"DIGEST": {"-1": "mug"}}},
        {"format": FORMAT, "trees": {"DIGEST": {"99999": "mug"}}},
        {"format": FORMAT, "trees": {"DIGEST": {"0": 7}}},
        ["mug"],
        None,
    ],
)
def test_a_damaged_file_is_refused_and_kept(desk, content):
    text = json.dumps(content).replace("DIGEST", tree_digest(desk / "default/semantic_tree"))
    (desk / FILE).write_text(text)
    with pytest.raises(ArtifactError, match=r"names\.json"):
        hilsplat.open(desk)
    assert (desk / FILE).read_text() == text
    (desk / FILE).unlink()


def test_what_looks_like_a_node_or_a_picture_comes_first(desk):
    scene = hilsplat.open(desk)
    found = nodes_by_text(scene)
    likes = scene.like_node(found["mug > handle"])
    green = likes[0]
    assert scene.tree.parent[green.node] == found["book"] and green.route == "like"  # the green label
    cosines = scene.tree.clip @ scene.tree.clip[found["mug > handle"]]
    assert [hit.score for hit in likes] == sorted((float(cosines[hit.node]) for hit in likes), reverse=True)
    assert {hit.level for hit in likes} == {hilsplat.Level.PART} and len(scene.like_node(0, limit=0)) == 0
    blue = np.zeros((7, 3, 3), np.uint8)
    blue[..., 2] = 250
    assert scene.like_picture(blue, limit=1)[0].node == found["book"]
    with pytest.raises(SettingsError, match="no node 99"):
        scene.like_node(99)
