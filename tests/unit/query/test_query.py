"""Queries on the world with two boxes: flat, along a path, of a view."""

import os
from dataclasses import replace

import numpy as np
import pytest

from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.base.levels import LEVELS, Level, spelt
from hilsplat.field.autoencoder import run_autoencoder
from hilsplat.field.code import LanguageField, load_code
from hilsplat.field.field import run_field
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.node_search import ancestor_margins, automatic_level, search
from hilsplat.scene.finished import FinishedScene
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import AutoencoderSettings, EvaluateSettings, FieldSettings, SemanticTreeSettings
from tests.unit.artifact_changes import write_record
from tests.unit.assembled_scene import assembled, with_views
from tests.unit.evaluate.plain_tree import plain_tree
from tests.unit.round_gaussians import round_gaussians
from tests.unit.two_boxes_world import (
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
    run_semantic_tree(contributions, world.masks, folder / "st", SemanticTreeSettings())
    settings = AutoencoderSettings(code="network", latent=4, epochs=1, min_steps=400, learning_rate=2e-3)
    run_autoencoder(world.clip, folder / "st", contributions, folder / "ae", settings, 0)
    run_field(
        contributions, world.coverage_tree, folder / "ae", folder / "field.safetensors", FieldSettings(), 1
    )
    rng = np.random.default_rng(9)
    vectors = {name: world.region_vectors[row] for row, (name, *_) in enumerate(REGIONS)}

    def encode(texts: list[str]) -> np.ndarray:
        new = {text: rng.normal(size=16) for text in texts if text not in vectors}
        vectors.update({text: vector / np.linalg.norm(vector) for text, vector in new.items()})
        return np.stack([vectors[text] for text in texts]).astype(np.float32)

    return assembled(
        Scene.load(world.scene),
        round_gaussians(np.zeros((NUM_GAUSSIANS, 3))),
        SemanticTree.load(folder / "st", world.clip),
        lambda view: two_boxes_weights(int(view[:3])),
        encode,
        (LanguageField.load(folder / "field.safetensors"), load_code(folder / "ae")),
    )


def near(scene, node_select: float = 0.85) -> LanguageScene:
    """The scene with another `node_select`."""
    return replace(scene, settings=scene.settings.model_copy(update={"node_select": node_select}))


@pytest.mark.parametrize("name", NODE)
def test_every_region_is_found_at_its_level(scene, name):
    level = Level(int(scene.tree.level[NODE[name]]))
    for asked in (level, None):
        assert near(scene).select((name,), level=asked).ids.tolist() == [NODE[name]]
    assert scene.query(name, level.label)[0].score > 0.9
    assert scene.query(name, level.label)[0].node == NODE[name]


def test_a_threshold_keeps_the_answers_with_at_least_that_score(scene):
    every = scene.query("A top", "part", threshold=1e-6, limit=99)
    scores = [hit.score for hit in every]
    assert len(every) == len(scene.tree.nodes_of(Level.PART)) and scores == sorted(scores, reverse=True)
    least = (scores[0] + scores[1]) / 2
    assert [hit.node for hit in scene.query("A top", "part", threshold=least)] == [every[0].node]
    assert scene.query("A top", "part", threshold=1 - 1e-9) == []
    for wrong in (0.0, 1.0, -2.0, float("nan")):
        with pytest.raises(SettingsError, match="between 0 and 1"):
            scene.query("A top", threshold=wrong)


def test_automatic_level_is_the_coarsest_level_of_the_best_nodes(scene):
    margin = np.full(7, -0.1)
    margin[[NODE["A top left"], NODE["A top"], NODE["A"]]] = 0.3, 0.2, 0.1
    assert automatic_level(scene.tree, margin, every := np.ones(7, bool)) == Level.SUBPART
    visible = np.arange(7) != NODE["A top left"]
    assert automatic_level(scene.tree, margin, visible) == Level.PART
    margin[NODE["A top"]] = 0.3
    assert automatic_level(scene.tree, margin, every) == Level.PART
    assert automatic_level(scene.tree, margin, np.zeros(7, bool)) == Level.WHOLE


def best_wholes(margin, threshold, vectors=None, hidden=()) -> list[int]:
    """Answers among wholes, whose vectors are orthogonal unless given."""
    num = len(margin)
    tree = plain_tree([1] * num, [-1] * num, [[-1, -1, -1]])
    vectors = np.eye(num, dtype=np.float32) if vectors is None else vectors
    margins, visible = np.array([margin], np.float32), ~np.isin(np.arange(num), hidden)
    options = {"level": Level.WHOLE, "visible": visible, "threshold": threshold, "ancestors": 0.2}
    return search(tree, margins, vectors, ("x",), **options).ids.tolist()


@pytest.mark.parametrize(
    ("margin", "threshold", "hidden", "found"),
    [
        ([-0.22, 0.29, 0.39, 0.69], 0.85, (), [3]),  # a range of 0.91, and 0.15 of it is 0.14
        ([-0.22, 0.29, 0.39, 0.69], 0.5, (), [3, 2, 1]),  # a half is 0.46
        ([-0.1, 0.2, 0.2], 0.95, (), [1, 2]),
        ([0.0, 9.4, 9.7, 10.0], 0.95, (3,), [2, 1]),  # within 0.05 of the range of all four, 10
        ([0.0, 9.4, 9.7, 10.0], 0.95, (0, 1, 2, 3), []),
    ],
)
def test_answers_are_within_a_share_of_the_range_of_all_nodes_below_the_best_shown(
    margin, threshold, hidden, found
):
    assert best_wholes(margin, threshold, hidden=hidden) == found


@pytest.mark.parametrize(("cosine", "found"), [(0.91, [3, 2]), (0.89, [3])])
def test_nodes_similar_to_the_best_answer_may_be_three_times_as_far_below(cosine, found):
    vectors = np.eye(5, dtype=np.float32)[:4]
    for node in (1, 2):
        vectors[node] = cosine * vectors[3] + np.sqrt(1 - cosine**2) * np.eye(5)[4]
    # of a range of 10: 0.05 is 0.5, three times that 1.5
    assert best_wholes([0.0, 7.0, 8.6, 10.0], 0.95, vectors) == found


def test_parts_of_a_likely_thing_are_ranked_first(scene):
    margin = np.full(7, -1.0)
    margin[[NODE["A"], NODE["A top"], NODE["A top left"]]] = 3.0, 1.0, 1.0
    margin[[NODE["B"], NODE["B corner"]]] = 0.0, 1.1
    added = ancestor_margins(scene.tree, margin)
    # A top left is part of A top and A, B corner of B alone; wholes are part of nothing and add nothing
    assert added[NODE["A top left"]] == pytest.approx(2.0)
    assert added[NODE["B corner"]] == pytest.approx(0.0)
    assert added[[NODE["A"], NODE["B"]]].tolist() == [0, 0]

    def found(ancestors):
        margins = margin[None].astype(np.float32)
        options = {"threshold": 0.9, "ancestors": ancestors, "level": Level.SUBPART}
        options["visible"] = np.ones(7, bool)
        return search(scene.tree, margins, scene.tree.clip, ("x",), **options)

    assert found(0.0).ids[0] == NODE["B corner"]
    assert found(0.2).ids.tolist() == [NODE["A top left"]]
    assert found(0.2).values == pytest.approx([1.4])  # its own, and a fifth of its ancestors' mean
    orphans = replace(scene.tree, parent=np.full(7, -1, np.int32))
    assert (ancestor_margins(orphans, margin)[scene.tree.level > 1] == -1.0).all()


def search_path(tree, named, threshold=0.99, level=None, hidden=()):
    """Search a path of one text for each of `named`: margins of named nodes; those of all others are -1."""
    margin = np.full((len(named), len(NAMES)), -1.0, np.float32)
    for row, values in zip(margin, named, strict=True):
        for name, value in values.items():
            row[NODE[name]] = value
    visible = ~np.isin(NAMES, hidden)
    options = {"level": level, "visible": visible, "threshold": threshold, "ancestors": 0.2}
    return search(tree, margin, tree.clip, tuple("xyz"[: len(named)]), **options)


def test_a_path_stays_inside_its_first_thing_at_levels_at_which_every_ancestor_exists(scene):
    named = {"A": 3.0}, {"A bottom": 2.0}, {"A top left": 0.4, "B corner": 2.2}
    hits = search_path(scene.tree, named, 0.95)
    # the one subpart of A hangs under its top; that of B answers better, but is no part of A
    assert (hits.ids.tolist(), hits.route) == ([NODE["A top left"]], "child")
    # B top has no subpart
    hits = search_path(scene.tree, ({"A": 0.8, "B top": 0.9}, {"A top left": 0.6, "B corner": 0.9}), 0.95)
    assert (hits.ids.tolist(), hits.route) == ([NODE["A top left"]], "descendant")


@pytest.fixture
def three_wholes(scene) -> SemanticTree:
    """B top is a separate whole, with the least margin: wholes range from -1 to 4 in the tests below."""
    level, parent = scene.tree.level.copy(), scene.tree.parent.copy()
    level[NODE["B top"]], parent[NODE["B top"]] = 1, -1
    return replace(scene.tree, level=level, parent=parent)


def orphaned(tree: SemanticTree, name: str | None) -> SemanticTree:
    return replace(tree, parent=np.where(np.array(NAMES) == name, -1, tree.parent).astype(np.int32))


@pytest.mark.parametrize(
    ("first", "last", "orphan", "found", "route"),
    [
        # A is best, B 1 below it, which counts half: 2.0 against 2.4 - 0.5 and 2.6 - 0.5
        ({"A": 4.0, "B": 3.0}, {"A top left": 2.0, "B corner": 2.4}, None, "A top left", "descendant"),
        ({"A": 4.0, "B": 3.0}, {"A top left": 2.0, "B corner": 2.6}, None, "B corner", "child"),
        # parts of a B further below A than 1.25, a quarter of the range of 5, do not compete
        ({"A": 4.0, "B": 2.7}, {"A top left": 0.0, "B corner": 9.0}, None, "A top left", "descendant"),
        ({"A": 4.0, "B": 2.8}, {"A top left": 0.0, "B corner": 9.0}, None, "B corner", "child"),
        # B top, the best whole, holds nothing, and all else is further below it: all nodes compete
        ({"A": 1, "B": 0, "B top": 4}, {"A top left": 1.0, "B corner": 1.2}, None, "A top left", "fallback"),
        # a missing ancestor counts half a tenth of the range, 0.25
        ({"A": 4.0}, {"A top left": 2.0, "B corner": 2.2}, "B corner", "A top left", "descendant"),
        ({"A": 4.0}, {"A top left": 2.0, "B corner": 2.3}, "B corner", "B corner", "fallback"),
    ],
)
def test_answers_of_a_path_depend_on_their_ancestors(three_wholes, first, last, orphan, found, route):
    hits = search_path(orphaned(three_wholes, orphan), (first, last), level=Level.SUBPART)
    assert (hits.ids.tolist(), hits.route) == ([NODE[found]], route)


def test_hidden_ancestors_do_not_compete_with_shown_ones(three_wholes):
    tree = orphaned(three_wholes, "B corner")
    # B top would leave A unlikely, and B corner, which nothing holds, the answer
    named = {"A": 1.0, "B top": 4.0}, {}, {"A top left": 2.0, "B corner": 0.0}
    for hidden, found in (("B", "B corner"), ("B top", "A top left")):
        hits = search_path(tree, named, hidden=hidden)
        assert hits.ids.tolist() == [NODE[found]]


def bear_without(root, *missing):
    """The folder of a scene in which empty folders and files stand for its parts."""
    folder = root / "results/photos/bear"
    for part in {"scene", *(f"default/{name}" for name in ("semantic_tree", "autoencoder", "clip", "masks"))}:
        if part not in missing:
            (folder / part).mkdir(parents=True)
    for name in {"gaussians.ply", "default/field.safetensors"} - {*missing}:
        (folder / name).touch()
    return folder


def test_a_scene_opens_with_the_settings_of_its_evaluation_or_panel(tmp_path, caplog):
    folder = bear_without(tmp_path)
    scores, panel = folder / "default/scores.csv", tmp_path / "results/figures/photos/bear/panel.webp"
    assert FinishedScene.locate(folder).evaluate_settings() == EvaluateSettings()
    assert "using the defaults" in caplog.text
    caplog.clear()
    panel.parent.mkdir(parents=True)  # a scene without labels has a panel only
    write_record(panel, settings={"figures": {}, "evaluate": {"template": "a photo of a {}"}})
    assert FinishedScene.locate(folder).evaluate_settings().template == "a photo of a {}"
    scores.touch()
    write_record(
        scores, settings={"evaluate": {"canonical": ["thing"], "node_select": 0.9, "a knob of old": 1}}
    )
    found = FinishedScene.locate(folder).evaluate_settings()
    assert (found.canonical, found.node_select) == (("thing",), 0.9)
    assert "using the defaults" not in caplog.text


def test_a_variant_uses_the_parts_recorded_in_its_scores_or_those_that_exist(tmp_path):
    later = ("default/semantic_tree", "default/autoencoder", "default/field.safetensors")
    with pytest.raises(ArtifactError, match=r"hilsplat run .*default/semantic_tree"):
        FinishedScene.locate(folder := bear_without(tmp_path, *later))
    (folder / "default/semantic_tree").mkdir()
    parts = FinishedScene.locate(folder).parts  # a tree can be queried before there is a field
    assert (parts.field, parts.autoencoder) == (None, None)
    assert list(parts.as_inputs()) == ["scene", "gaussians", "semantic_tree", "clip", "masks"]
    (folder / "lifted").mkdir()  # begun, and killed
    (folder / "default/autoencoder").mkdir()
    (folder / "default/field.safetensors").touch()
    with pytest.raises(ArtifactError, match=r"lifted/field\.safetensors is missing"):
        FinishedScene.locate(folder, "lifted")
    (folder / "theta").mkdir()
    (folder / "theta/scores.csv").touch()
    inputs = {"field": {"path": "results/photos/bear/default/field.safetensors"}}
    write_record(folder / "theta/scores.csv", inputs=inputs)
    found = FinishedScene.locate(folder, "theta").parts
    assert found.field == folder / "default/field.safetensors"
    assert found.semantic_tree == folder / "default/semantic_tree"
    own = folder / "theta/field.safetensors"
    own.touch()
    write_record(own, inputs={"autoencoder": {"path": "results/photos/bear/default/autoencoder"}})
    for time_s, used in ((0, found.field), (2**32, own)):  # of before it shared the field, and made since
        os.utime(own, (time_s, time_s))
        assert FinishedScene.locate(folder, "theta").parts.field == used
    with pytest.raises(ArtifactError, match="no variant 'x'"):
        FinishedScene.locate(folder, "x")


def test_while_a_scene_is_rebuilt_new_parts_precede_those_of_the_previous_run(tmp_path, monkeypatch):
    folder = bear_without(tmp_path)
    monkeypatch.setattr("hilsplat.scene.finished.refining", lambda folder: "few photographs")
    for part in ("clip", "masks", "semantic_tree"):
        (folder / "key-views" / part).mkdir(parents=True)

    def make(name: str, poses: str) -> None:
        inputs = {"scene": {"path": str(folder / "scene"), "sha256": poses}}
        write_record(folder / name, inputs=inputs)

    def used() -> tuple[str, bool]:
        parts = FinishedScene.locate(folder).parts
        return parts.clip.parent.name, parts.field is not None

    def rebuild(poses: str) -> None:
        write_record(folder / "scene", outputs={"scene": {"sha256": poses, "bytes": {}}})

    rebuild("old")
    vectors = ("default/clip", "default/field.safetensors", "key-views/clip")
    for name in vectors:
        make(name, "old")
    assert used() == ("default", True)
    rebuild("new")
    assert used() == ("default", True)  # nothing is new yet: opening it names what changed
    for name, expected in (("key-views", False), ("default", False)):
        make(f"{name}/clip", "new")
        assert used() == (name, expected)
    make("default/field.safetensors", "new")
    assert used() == ("default", True)


def test_the_field_answers_through_the_same_interface_and_by_look_ups(scene):
    hits = scene.query("B", "whole", answerer="field")
    assert hits[0].node == NODE["B"]
    (hit,) = scene.query("A > A top", answerer="field")
    assert (hit.node, hit.route) == (NODE["A top"], "child")
    exact = scene.field.relevancy(["B", "A top"], "004.png")
    fast = scene.field.relevancy(["B", "A top"], "004.png", exact=False)
    assert fast == pytest.approx(exact, abs=2e-3)  # a network with d = 4: decoded as well


@pytest.mark.parametrize(
    ("path", "level", "found"),
    [
        (("A", "A top left"), None, "A top left"),  # a subpart, with the part in between left out
        (("A", "A top left"), Level.SUBPART, "A top left"),
        (("A", "A top left"), Level.PART, "A top"),  # the part most like it
        (("A", "A bottom"), None, "A bottom"),
        (("A top", "A top left"), None, "A top left"),  # the first text need be no whole
        (("B", "B corner"), None, "B corner"),
        (("A", "A top", "A top left"), None, "A top left"),
        (("B", "A top"), None, "B top"),  # inside B only a part of B
        (("B", "B top", "B corner"), None, "B corner"),  # B top has no subpart, and B corner hangs under B
    ],
)
def test_a_path_finds_its_levels_unless_one_is_given(scene, path, level, found):
    hits = near(scene).select(path, level=level)
    assert hits.ids.tolist() == [NODE[found]]
    assert hits.level == Level(int(scene.tree.level[NODE[found]]))


@pytest.mark.parametrize("text", ["A top left", "A > A top left"])
def test_answers_in_a_view_are_nodes_that_it_shows(scene, text):
    assert scene.views.visible_nodes("000.png").all()
    half = with_views(scene)
    half.views.cache.get(("visible", "000.png"), lambda: np.arange(7) != NODE["A top left"])
    assert [hit.node for hit in half.query(text, "subpart", view="000.png")] == [NODE["B corner"]]
    dark = with_views(scene)
    dark.views.cache.get(("visible", "000.png"), lambda: np.zeros(7, bool))
    assert dark.query(text, view="000.png") == []
    with pytest.raises(SettingsError, match="has no view 'x'"):
        scene.query(text, view="x")


def test_views_are_found_however_their_names_are_composed(scene):
    """macOS decomposes names of files, and keyboards type composed letters."""
    stored, typed = "Gro\u0308ße.png", "Gr\u00f6ße.png"
    cameras = replace(scene.scene.cameras, names=(stored, *scene.scene.cameras.names[1:]))
    views = replace(scene.views, scene=replace(scene.scene, cameras=cameras))
    assert cameras[typed].name == views.camera(typed).name == stored
    assert spelt("000.png", cameras.names) is None
    with pytest.raises(ArtifactError, match=stored):  # not the name that was typed
        views.image(typed)


def test_a_view_shows_the_nodes_with_a_mask_there(scene, monkeypatch):
    monkeypatch.setattr("hilsplat.query.scene_views.MIN_VISIBLE_SHARE", 8 / (HEIGHT * WIDTH))
    visible = with_views(scene).views.visible_nodes("000.png")
    # B corner has 2 x 3 px, A top left 4 x 2
    assert np.flatnonzero(~visible).tolist() == [NODE["B corner"]]


def test_hits_and_masks_describe_nodes_and_their_places(scene):
    (hit,) = scene.query("A > A top")
    assert (hit.node, hit.level, hit.route) == (NODE["A top"], Level.PART, "child")
    assert hit.score > 0.9 and hit.best_views == ("000.png", "001.png", "002.png")
    assert hit.box[0][0] <= hit.centroid[0] <= hit.box[1][0]
    (hit,) = scene.query("A top left", "subpart")
    assert hit.gaussians.tolist() == np.flatnonzero(region_mask(5)).tolist()
    assert np.array_equal(hit.mask("004.png"), np.roll(region_mask(5), 4, axis=1))
    # 2 columns and 4 rows of Gaussians one unit apart, in a plane
    assert hit.oriented_box.size == pytest.approx((2.88, 1, 0), abs=0.15)
    mask = scene.views.node_masks("004.png", np.array([NODE["A bottom"]]))
    assert np.array_equal(mask, np.roll(region_mask(3), 4, axis=1))
    both = scene.views.node_masks("000.png", np.array([NODE["A bottom"], NODE["A top left"]]))
    assert np.array_equal(both, region_mask(3) | region_mask(5))


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("a > b > c > d", {}, "1 to 3 texts"),
        ("a > b > c", {"level": "part"}, "cannot be searched at level part"),
        (" ", {}, "an empty text"),
        ("A", {"level": "hole"}, r"unknown(.|\n)*also accept auto"),
        ("A > A top", {"level": "hole"}, "unknown"),
        ("A", {"answerer": "tre"}, "answerer 'tre' is unknown"),
    ],
)
def test_impossible_queries_are_refused(scene, text, options, words):
    with pytest.raises(SettingsError, match=words):
        scene.query(text, **options)


@pytest.fixture
def thin(scene) -> LanguageScene:
    """The scene with a first pixel that shows nothing."""
    weights = two_boxes_weights(0).tolil()
    weights[0] = 0
    return with_views(scene, weights=lambda view: weights.tocsr())


def test_cosines_at_pixels_are_those_of_latents_and_nodes_and_uncovered_ones_are_the_lowest(thin):
    texts, pixels = ["B", "A top"], np.arange(0, HEIGHT * WIDTH, 7)
    vectors, shares = thin.clip.embed_texts(texts), thin.views.view_weights("000.png").toarray()[pixels]
    by_field, by_node = (of(texts, "000.png", pixels) for of in (thin.field.cosine, thin.node_cosine))
    for level in LEVELS:
        features = thin.field.language.features[:, level.index]
        mass = shares @ (features != 0).any(axis=1).astype(np.float32)
        latents = shares @ features / np.maximum(mass, 0.5)[:, None]
        expected = np.where(mass > 0.5, vectors @ thin.field.code.decode_array(latents).T, -np.inf)
        assert by_field[:, level.index] == pytest.approx(expected, abs=1e-5)
        node, cosines = thin.tree.node_of_gaussian[:, level.index], vectors @ thin.tree.clip.T
        lowest = cosines[:, thin.tree.nodes_of(level)].min(axis=1, keepdims=True)
        expected = np.where(node >= 0, cosines[:, node], lowest) @ shares.T
        expected = np.where(shares.any(axis=1), expected, -np.inf)
        assert by_node[:, level.index] == pytest.approx(expected, abs=1e-5)
    assert np.isinf(by_node[:, :, 0]).all()
    for maps in (thin.field.relevancy(["A"], "000.png"), thin.node_relevancy_map(["A"], "000.png")):
        assert maps[0, 0, 0, 0] == maps[0, 0].min()
    assert not thin.views.node_masks("000.png", np.array([NODE["A"]]))[0, 0]


def test_latents_are_means_over_the_gaussians_that_have_one(scene):
    features = scene.field.language.features.copy()
    features[::7] = 0
    language = replace(scene.field.language, features=features)
    thin = replace(with_views(scene).field, language=language)
    weights = scene.views.view_weights("000.png")
    for index, (pixels, latents) in enumerate(thin.latents("000.png")):
        own = np.ascontiguousarray(features[:, index])
        share = weights @ (own != 0).any(axis=1).astype(np.float32)
        assert pixels.tolist() == np.flatnonzero(share > 0.5).tolist()
        assert (share[pixels] < 0.99).any()
        assert latents.tobytes() == ((weights[pixels] @ own) / share[pixels, None]).tobytes()


def test_field_image_has_one_colour_per_region(scene):
    image = scene.field.image("000.png", Level.WHOLE)
    assert image.shape == (HEIGHT, WIDTH, 3)
    a, b = image[region_mask(0)].mean(axis=0), image[region_mask(1)].mean(axis=0)
    assert np.abs(a - b).max() > 50
