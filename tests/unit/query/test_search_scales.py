"""Searches whose scales could vanish: a single thing, saturated relevancies, texts without a match."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.levels import Level
from hilsplat.query.hits import doubts_of
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.node_search import search
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import EvaluateSettings
from tests.unit.assembled_scene import assembled
from tests.unit.evaluate.builders import cameras_of
from tests.unit.evaluate.plain_tree import plain_tree
from tests.unit.query.test_query import near
from tests.unit.round_gaussians import round_gaussians


def tree_of(levels: list[int], parents: list[int]) -> SemanticTree:
    """A tree whose nodes have orthogonal vectors."""
    return plain_tree(levels, parents, [[-1, -1, -1]], clip=np.eye(len(levels), dtype=np.float32))


def searched(tree: SemanticTree, margin: list[list[float]], *path: str, **options):
    """Search with the default settings."""
    margins = np.array(margin, np.float32)
    options = {"threshold": 0.95, "ancestors": 0.2, "visible": np.ones(len(tree), bool), **options}
    return search(tree, margins, tree.clip, path, **options)


@pytest.mark.parametrize(("bear", "heads_as_bear"), [(3.0, 3.0), (3.0, 0.0), (3.0, -1.0), (-3.0, 0.0)])
def test_in_a_scene_of_one_thing_its_part_is_ahead_of_an_orphan(bear, heads_as_bear):
    # one whole, its head and an orphan: the range of the wholes alone is 0. With the generic phrase it is 3,
    # and half a tenth of that, 0.15, is taken off the orphan's 2.01
    tree, margin = tree_of([1, 2, 2], [-1, 0, -1]), [bear, heads_as_bear, heads_as_bear]
    hits = searched(tree, [margin, [0.0, 2.00, 2.01]], "bear", "head")
    assert (hits.ids.tolist(), hits.route) == ([1], "child")
    assert searched(tree, [margin, [0.0, 2.00, 2.16]], "bear", "head").ids.tolist() == [2]


COSINES = (0.30, 0.35, 0.28)
GENERIC = 0.10


@pytest.fixture
def three_mugs() -> LanguageScene:
    """Three wholes at known cosines with "mug", all at 0.10 with every generic phrase."""
    tree = tree_of([1, 1, 1], [-1, -1, -1])
    vectors = np.zeros((3, 6), np.float32)
    for row, cosine in enumerate(COSINES):
        vectors[row, :2] = cosine, GENERIC
        vectors[row, 2 + row] = np.sqrt(1 - cosine**2 - GENERIC**2)
    axes = {"mug": 0, "unicorn": 5}

    def encode(texts: list[str]) -> np.ndarray:
        return np.eye(6, dtype=np.float32)[[axes.get(text, 1) for text in texts]]

    settings = EvaluateSettings(relevancy_scale=100)
    cameras, nothing = cameras_of(np.eye(4)[None], np.eye(3), (2, 2)), np.zeros((0, 3), np.float32)
    split, colours = {"000.png": "train"}, nothing.astype(np.uint8)
    return assembled(
        Scene(Path(), "toy/mugs", "metre", cameras, split, nothing, colours, np.eye(4)),
        round_gaussians(np.zeros((1, 3))),
        replace(tree, clip=vectors),
        lambda view: sp.csr_matrix((4, 1), dtype=np.float32),
        encode,
        settings=settings,
    )


def test_a_large_scale_saturates_scores_but_neither_the_ranking_nor_doubts(three_mugs):
    scores = three_mugs.node_relevancy(["mug"])[0]
    assert scores.tolist() == [1.0, 1.0, 1.0]  # 1 / (1 + exp(-18)) in float32
    assert near(three_mugs, 0.0).select(["mug"]).ids.tolist() == [1, 0, 2]
    assert three_mugs.select(["mug"]).ids.tolist() == [1]
    assert three_mugs.query("mug")[0].score == pytest.approx(1.0)
    (doubt,) = three_mugs.query("unicorn", "whole")[0].doubts
    # cosine 0 with the text and 0.1 with the nearest phrase
    assert (doubt.text, doubt.level) == ("unicorn", None)
    assert str(doubt) == "no node is closer to 'unicorn' than to a generic word"
    assert three_mugs.query("mug")[0].doubts == ()


def test_the_first_text_of_a_path_is_doubted_even_if_the_last_has_a_good_match():
    tree = tree_of([1, 1, 2], [-1, -1, 0])
    hits = searched(tree, [[-0.1, -0.2, 0.3], [-0.5, -0.5, 0.3]], "unicorn", "head")
    assert (hits.ids.tolist(), hits.route) == ([2], "child")
    assert [(each.text, each.level, each.margin <= 0) for each in hits.texts] == [
        ("unicorn", Level.WHOLE, True),
        ("head", Level.PART, False),
    ]
    # a part does answer to "unicorn", but it was searched among wholes
    (doubt,) = doubts_of(hits)
    assert (doubt.text, doubt.level) == ("unicorn", Level.WHOLE)
    assert str(doubt) == "no whole is closer to 'unicorn' than to a generic word"


def test_doubts_consider_only_nodes_shown_in_the_view():
    tree = tree_of([1, 1, 2, 2], [-1, -1, 0, 1])
    margin = [[0.4, -0.1, 0, 0], [0, 0, 0.3, 0.3]]
    assert searched(tree, margin, "mug", "handle").texts[0].margin > 0
    visible = np.array([False, True, False, True])
    hits = searched(tree, margin, "mug", "handle", visible=visible)
    assert hits.texts[0].margin == pytest.approx(-0.1)
