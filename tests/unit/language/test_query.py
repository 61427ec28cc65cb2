"""Queries on the world with two boxes: flat, along a path, with every fall-back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hilsplat.base.errors import MisalignedArtifactError, SettingsError
from hilsplat.base.levels import Level
from hilsplat.language.autoencoder import Autoencoder, run_autoencoder
from hilsplat.language.field import LanguageField, run_language
from hilsplat.language.query import LanguageScene, require_same
from hilsplat.language.semantic_tree import SemanticTree, run_semantic_tree
from hilsplat.scene.scene import Scene
from hilsplat.settings import AutoencoderSettings, LanguageSettings, SemanticTreeSettings
from hilsplat.splat.gaussians import Gaussians
from tests.unit.language.two_boxes_world import (
    HEIGHT,
    NUM_GAUSSIANS,
    REGIONS,
    WIDTH,
    build_contributions,
    build_two_boxes,
    region_mask,
    two_boxes_weights,
)

NAMES = ("A", "B", "A top", "B top", "A bottom", "A top left", "B corner")
NODE = {name: node for node, name in enumerate(NAMES)}


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> LanguageScene:
    folder = tmp_path_factory.mktemp("boxes")
    with pytest.MonkeyPatch.context() as monkeypatch:
        world = build_two_boxes(folder, monkeypatch)
        contributions = build_contributions(world)
    run_semantic_tree(contributions, world.masks, world.clip, folder / "st", SemanticTreeSettings())
    settings = AutoencoderSettings(latent=4, epochs=1, min_steps=400, learning_rate=2e-3)
    run_autoencoder(world.clip, folder / "st", contributions, folder / "ae", settings, 0)
    run_language(
        contributions, world.tree, folder / "ae", folder / "language.safetensors", LanguageSettings(), 0, 1
    )
    rng = np.random.default_rng(9)
    vectors = {name: world.region_vectors[row] for row, (name, *_) in enumerate(REGIONS)}

    def encode(texts: list[str]) -> np.ndarray:
        new = {text: rng.normal(size=16) for text in texts if text not in vectors}
        vectors.update({text: vector / np.linalg.norm(vector) for text, vector in new.items()})
        return np.stack([vectors[text] for text in texts]).astype(np.float32)

    zeros = torch.zeros(NUM_GAUSSIANS, 3)
    return LanguageScene(
        Scene.load(world.scene),
        Gaussians(zeros, zeros, torch.zeros(NUM_GAUSSIANS, 4), torch.zeros(NUM_GAUSSIANS), zeros[:, None]),
        SemanticTree.load(folder / "st"),
        LanguageField.load(folder / "language.safetensors"),
        Autoencoder.load(folder / "ae"),
        encode,
        lambda view: two_boxes_weights(int(view[:3])),
    )


@pytest.mark.parametrize("name", NODE)
def test_every_region_is_found_at_its_level(scene, name):
    level = Level(int(scene.tree.level[NODE[name]]))
    hits = scene.select_nodes(name, level=level, threshold=0.85)
    assert hits.ids.tolist() == [NODE[name]]
    assert hits.scores[0] > 0.9
    assert scene.query(name, level.label)[0].node == NODE[name]


@pytest.mark.parametrize("name", NODE)
def test_automatic_level_is_the_region_s_own(scene, name):
    assert scene.select_nodes(name, level=None, threshold=0.85).ids.tolist() == [NODE[name]]


def test_automatic_level_climbs_to_a_parent_that_scores_as_well(scene):
    def sigmoid(margin: float) -> float:
        return 1 / (1 + np.exp(-margin))

    scores = np.full(7, sigmoid(0.0), np.float32)
    # of the range 0 to 2 a parent needs 0.9, that is 1.8
    scores[[NODE["A top left"], NODE["A top"], NODE["A"]]] = sigmoid(2.0), sigmoid(1.9), sigmoid(1.7)
    assert scene.automatic_level(scores) == Level.PART
    scores[NODE["A"]] = sigmoid(1.85)
    assert scene.automatic_level(scores) == Level.WHOLE
    scores[NODE["A top"]] = sigmoid(1.7)
    assert scene.automatic_level(scores) == Level.SUBPART


def test_only_the_given_nodes_compete(scene):
    children = scene.tree.children_of(np.array([NODE["B"]]))
    hits = scene.select_nodes("A top", level=Level.PART, threshold=0.85, within=children)
    assert hits.ids.tolist() == [NODE["B top"]]


def test_path_goes_from_child_to_child(scene):
    hits = scene.select_path(("A", "A top", "A top left"), 0.85)
    assert hits.ids.tolist() == [NODE["A top left"]]
    assert hits.route == "child"
    assert hits.level == Level.SUBPART


def test_path_restricts_a_part_to_its_object(scene):
    # "A top" asked inside B can only be a part of B
    assert scene.select_path(("B", "A top"), 0.85).ids.tolist() == [NODE["B top"]]


def test_path_falls_back_to_any_descendant_of_the_object(scene):
    # "B top" has no subpart; "B corner" hangs directly under B
    hits = scene.select_path(("B", "B top", "B corner"), 0.85)
    assert hits.ids.tolist() == [NODE["B corner"]]
    assert hits.route == "descendant"


def test_path_falls_back_to_the_whole_level(scene):
    parent = np.where(scene.tree.level == Level.SUBPART, -1, scene.tree.parent).astype(np.int32)
    orphaned = replace(scene, tree=replace(scene.tree, parent=parent))
    hits = orphaned.select_path(("A", "A top", "B corner"), 0.85)
    assert hits.ids.tolist() == [NODE["B corner"]]
    assert hits.route == "fallback"


def test_query_parses_paths_and_describes_hits(scene):
    (hit,) = scene.query("A > A top")
    assert (hit.node, hit.level, hit.route) == (NODE["A top"], Level.PART, "child")
    assert hit.score > 0.9
    assert hit.best_views == ("000.png", "001.png", "002.png")
    assert hit.box[0][0] <= hit.centroid[0] <= hit.box[1][0]


@pytest.mark.parametrize(
    ("text", "level", "words"),
    [("a > b > c > d", "auto", "1 to 3 texts"), (" ", "auto", "holds no text"), ("A", "hole", "unknown")],
)
def test_impossible_queries_say_why(scene, text, level, words):
    with pytest.raises(SettingsError, match=words):
        scene.query(text, level)


def test_node_masks_cover_their_region_in_an_unseen_view(scene):
    mask = scene.node_masks("004.png", np.array([NODE["A bottom"]]))
    assert np.array_equal(mask, np.roll(region_mask(3), 4, axis=1))
    both = scene.node_masks("000.png", np.array([NODE["A bottom"], NODE["A top left"]]))
    assert np.array_equal(both, region_mask(3) | region_mask(5))


def test_node_map_is_high_where_the_node_is(scene):
    maps = scene.node_relevancy_map(["B", "A top"], "004.png")
    assert maps.shape == (2, 3, HEIGHT, WIDTH)
    inside = np.roll(region_mask(1), 4, axis=1)
    assert maps[0, 0][inside].min() > maps[0, 0][~inside].max()
    top = np.roll(region_mask(2), 4, axis=1)
    assert maps[1, 1][top].min() > maps[1, 1][~top].max()


def test_field_answers_where_the_region_is(scene):
    maps = scene.field_relevancy(["B", "A top"], "004.png")
    assert maps.shape == (2, 3, HEIGHT, WIDTH)
    inside = np.roll(region_mask(1), 4, axis=1)
    assert maps[0, 0][inside].mean() > maps[0, 0][~inside].mean() + 0.05
    top = np.roll(region_mask(2), 4, axis=1)
    assert maps[1, 1][top].mean() > maps[1, 1][~top].mean() + 0.05


def test_uncovered_pixels_get_the_least_relevancy(scene):
    weights = two_boxes_weights(0).tolil()
    weights[0] = 0
    thin = replace(scene, pixel_weights=lambda view: weights.tocsr(), _views={})
    for maps in (thin.field_relevancy(["A"], "000.png"), thin.node_relevancy_map(["A"], "000.png")):
        assert maps[0, 0, 0, 0] == maps[0, 0].min()
    assert not thin.node_masks("000.png", np.array([NODE["A"]]))[0, 0]


def test_field_image_has_one_colour_per_region(scene):
    image = scene.field_image("000.png", Level.WHOLE)
    assert image.shape == (HEIGHT, WIDTH, 3)
    a, b = image[region_mask(0)].mean(axis=0), image[region_mask(1)].mean(axis=0)
    assert np.abs(a - b).max() > 50
    assert np.array_equal(image, scene.field_image("000.png", Level.WHOLE))


def test_artifacts_of_other_gaussians_are_refused(tmp_path):
    path = tmp_path / "gaussians.ply"
    path.write_bytes(b"new")
    with pytest.raises(MisalignedArtifactError, match="language field of toy was made"):
        require_same("language field", "toy", path, "0" * 64)
