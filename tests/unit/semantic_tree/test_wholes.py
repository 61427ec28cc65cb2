"""Regions that touch in 3D are joined to wholes."""

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.artifacts import read_index, write_index
from hilsplat.base.levels import Level
from hilsplat.semantic_tree import wholes
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.semantic_tree.nodes import LevelNodes
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.semantic_tree.wholes import joined, joined_regions, touching
from hilsplat.settings import SemanticTreeSettings


def on_a_line(*x: float) -> np.ndarray:
    return np.array([[each, 0, 0] for each in x], np.float32)


def test_regions_touch_where_gaussians_are_neighbours(monkeypatch):
    monkeypatch.setattr(wholes, "NEIGHBOURS", 2)  # itself and one other
    region = np.array([0, 0, 1, 1, 2, 2], np.int32)
    # 0.0-1.0-1.5: the middle one is nearest to region 1, and is the nearest of its Gaussian at 1.5, too
    touch = touching(region, 3, on_a_line(0, 1, 1.5, 2.1, 9, 9.5)).toarray()
    assert touch.tolist() == [[0, 2, 0], [2, 0, 0], [0, 0, 0]]


def joined_by_search(touch: np.ndarray, shares: np.ndarray, most: float) -> list[list[int]]:
    """The rule written out: all pairs are compared before every join."""
    groups = [[region] for region in range(len(shares))]

    def side(group: list[int]) -> float:
        share = shares[group].sum(axis=0)
        return float(np.sqrt(share[share > 1e-4].mean()))

    def touches(one: list[int], other: list[int]) -> float:
        return touch[np.ix_(one, other)].sum()

    while True:
        best, pair = most, None
        for a in range(len(groups)):
            for b in range(a + 1, len(groups)):
                if not touches(groups[a], groups[b]):
                    continue
                smaller = a if side(groups[a]) < side(groups[b]) else b
                around = sum(touches(groups[smaller], each) for each in groups if each is not groups[smaller])
                cost = side(groups[a] + groups[b]) * (around / touches(groups[a], groups[b])) ** 0.5
                if cost < best:
                    best, pair = cost, (a, b)
        if pair is None:
            return sorted(sorted(group) for group in groups)
        groups[pair[0]] += groups.pop(pair[1])


@pytest.mark.parametrize("seed", range(5))
def test_joining_equals_a_search_over_all_pairs(seed):
    rng = np.random.default_rng(seed)
    touch = np.triu(rng.integers(1, 40, (18, 18)) * (rng.random((18, 18)) < 0.25), 1)
    touch = (touch + touch.T).astype(float)
    shares = rng.uniform(0.001, 0.02, (18, 4)) * (rng.random((18, 4)) < 0.8)
    shares[:, 0] += 0.001
    whole = joined(sp.csr_matrix(touch), shares, 0.3)
    found = sorted(sorted(np.flatnonzero(whole == each).tolist()) for each in np.unique(whole))
    assert 3 < len(found) < 16
    assert found == joined_by_search(touch, shares, 0.3)


def test_floating_gaussians_and_those_without_region_join_nothing():
    region = np.array([0, 0, -1, 1, 1, 1], np.int32)
    means = on_a_line(0, 1, 2, 3, 4, 1.1)
    mass = sp.csr_matrix(np.array([[9, 9, 9, 9, 9, 0.5]], np.float32))
    assert joined_regions(region, 2, means, mass, 5.0).tolist() == [0, 0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wholes, "NEIGHBOURS", 2)  # the floating one at 1.1 alone would touch region 0
        assert joined_regions(region, 2, means, mass, 5.0).tolist() == [0, 1]
    none = np.full(3, -1, np.int32)
    seen = sp.csr_matrix(np.ones((1, 3), np.float32))
    assert len(joined_regions(none, 0, on_a_line(0, 1, 2), seen, 1.0)) == 0


def test_joined_nodes_keep_their_masks_gaussians_and_mean_quality():
    nodes = LevelNodes(
        np.array([0, 1, 1, 2, -1]),
        np.array([0, 1, 2, -1], np.int32),
        np.ones(4, np.float32),
        np.array([0.9, 0.3, 0.5]),
    )
    whole = nodes.joined(np.array([0, 0, 1]))
    assert whole.of_mask.tolist() == [0, 0, 0, 1, -1]
    assert whole.of_gaussian.tolist() == [0, 0, 1, -1]
    assert whole.quality == pytest.approx([0.5, 0.5])  # (0.9 + 2 * 0.3) / 3


@pytest.mark.parametrize(
    ("segmenter", "most", "wholes"), [("graph", 1.1, 1), ("graph", 0.9, 2), ("sam", 1.1, 2)]
)
def test_only_wholes_of_the_graph_segmenter_are_joined(two_boxes_contributions, segmenter, most, wholes):
    # boxes A and B fill every view together and touch only each other: the pair costs 1
    world, contributions = two_boxes_contributions
    write_index(world.masks, read_index(world.masks)["views"], segmenter=segmenter)
    run_semantic_tree(contributions, world.masks, world.folder / "t", SemanticTreeSettings(whole_side=most))
    tree = SemanticTree.load(world.folder / "t")
    assert [len(tree.nodes_of(level)) for level in Level] == [wholes, 3, 2]
    if wholes == 1:
        assert (tree.node_of_gaussian[:, 0] == 0).all()
        assert (tree.ancestors()[:, 0] == 0).all()
        # a mask of a piece shows the whole, and the whole's area in a view is that of its pieces
        assert (tree.node_of_mask[:2] == 0).all()
        assert tree.view_area_px[0] == pytest.approx(np.full(4, 96.0))
