"""Nodes of linked masks, and the tree of a world whose nodes are known."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.artifacts import read_index, read_json, read_npy, sha256_of_path, write_index, write_npy
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.levels import Level
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.semantic_tree.level_nodes import level_nodes
from hilsplat.semantic_tree.nodes import gaussian_nodes, nearest_gaussians, node_parents, without_strays
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import SemanticTreeSettings
from tests.unit.artifact_changes import change_index
from tests.unit.two_boxes_world import (
    HEIGHT,
    NUM_GAUSSIANS,
    REGIONS,
    WIDTH,
    region_mask,
    reverse_masks,
)


def test_gaussians_join_the_node_with_the_largest_share():
    weights = sp.csr_matrix(np.array([[5, 1, 2], [4, 1, 2], [2, 0, 1]], np.float32))
    mass = np.full((2, 3), 5, np.float32)
    # nodes: masks 0 and 1 are node 0 in views 0 and 1, mask 2 is node 1 in view 1 alone
    node, membership = gaussian_nodes(
        np.array([0, 0, 1]), 2, weights, np.array([0, 1, 1], np.int32), mass, np.full(3, 10.0), 0.25
    )
    # Gaussian 0: 9 of 10 px in node 0, 2 in node 1; Gaussian 1: 2 of 10 is too little
    assert node.tolist() == [0, -1, 0]
    assert membership == pytest.approx([0.9, 0, 0.4])


def test_a_small_node_keeps_its_gaussian_where_a_large_one_sometimes_covers_it():
    # Ten views of one Gaussian of 1 px. Node 0 has masks in all views, and five cover the Gaussian;
    # node 1 has masks in four views, and all cover it.
    weights = sp.csr_matrix(np.array([[1]] * 5 + [[0]] * 5 + [[1]] * 4, np.float32))
    view = np.array([*range(10), *range(5, 9)], np.int32)
    cluster = np.array([0] * 10 + [1] * 4)
    node, membership = gaussian_nodes(
        cluster, 2, weights, view, np.ones((10, 1), np.float32), np.full(1, 10.0), 0.05
    )
    # 5/10 * 5/(10 + 3) against 4/10 * 4/(4 + 3)
    assert (node[0], membership[0]) == (1, pytest.approx(0.4))


def test_of_a_tie_the_lower_node():
    weights = sp.csr_matrix(np.array([[3], [3]], np.float32))
    mass = np.full((2, 1), 5, np.float32)
    found = gaussian_nodes(
        np.array([1, 0]), 2, weights, np.arange(2, dtype=np.int32), mass, np.full(1, 10.0), 0.0
    )
    assert found[0].tolist() == [0]


def test_overlapping_masks_of_one_view_count_a_gaussian_once():
    weights = sp.csr_matrix(np.array([[4, 2], [4, 0], [0, 2], [5, 3]], np.float32))
    view = np.array([0, 0, 0, 1], np.int32)
    mass = np.array([[4, 4], [6, 6]], np.float32)
    # masks 0 and 1 are node 0, twice the same 4 of 4 px of Gaussian 0; mask 3 is node 1, with 5 of 6 px
    node, membership = gaussian_nodes(np.array([0, 0, -1, 1]), 2, weights, view, mass, np.full(2, 10.0), 0.1)
    assert node.tolist() == [1, 1]
    assert membership == pytest.approx([0.5, 0.3])


def test_small_pieces_apart_from_their_node_leave_it():
    # two nodes on a line: node 0 at 0 to 39 and, one unit of mass in 52, at 200; node 1 beside the latter
    means = np.zeros((52, 3))
    means[:, 0] = [*range(40), 200, *range(201, 212)]
    nodes = np.array([0] * 41 + [1] * 11, np.int32)
    nearest = nearest_gaussians(means, 1)
    kept = without_strays(nodes, nearest, np.full(52, 2.0))
    assert kept.tolist() == nodes.tolist()  # one of forty is more than 2 %
    mass = np.full(52, 2.0)
    mass[40] = 1.0
    assert np.flatnonzero(without_strays(nodes, nearest, mass) != nodes).tolist() == [40]
    nodes[:] = -1
    assert (without_strays(nodes, nearest, mass) == -1).all()


def test_a_double_that_shows_nothing_is_no_node():
    # Four views of ten Gaussians: one mask of all (two views miss Gaussian 3), and in three of the views
    # one of the first four. Those are a cluster of their own and win Gaussian 3 alone, which none shows.
    whole = np.ones((4, 10))
    whole[:2, 3] = 0
    double = np.repeat((np.arange(10) < 4)[None], 3, axis=0)
    weights = sp.csr_matrix(np.concatenate([whole, double]).astype(np.float32))
    view = np.array([0, 1, 2, 3, 0, 1, 2], np.int32)
    mass, once = np.ones((4, 10), np.float32), np.ones(10)
    seen = mass > 0

    found = level_nodes(weights, view, mass, seen, once, 4 * once, SemanticTreeSettings(), 1)
    assert found.of_mask.tolist() == [0, 0, 0, 0, -1, -1, -1]
    assert found.of_gaussian.tolist() == [0] * 10
    assert found.membership == pytest.approx(np.where(np.arange(10) == 3, 0.5, 1.0))
    assert len(found.quality) == 1

    whole[:2, :4] = 0  # now it wins all four, and is a node
    weights = sp.csr_matrix(np.concatenate([whole, double]).astype(np.float32))
    found = level_nodes(weights, view, mass, seen, once, 4 * once, SemanticTreeSettings(), 1)
    assert found.of_gaussian.tolist() == [1] * 4 + [0] * 6


def test_subpart_may_hang_directly_under_a_whole():
    node_of_gaussian = np.array([[0, 1, 2], [0, 1, 2], [0, -1, 3], [0, -1, 3], [-1, -1, 4]], np.int32)
    level = np.array([1, 2, 3, 3, 3], np.uint8)
    assert node_parents(node_of_gaussian, level, np.ones(5), 0.5).tolist() == [-1, 0, 1, 0, -1]
    # a cover of exactly the threshold is not enough
    heavy = np.array([1.0, 1, 1, 1, 1])
    half = np.array([[0, 1, -1], [-1, 1, -1]], np.int32)
    assert node_parents(half, np.array([1, 2], np.uint8), heavy[:2], 0.5).tolist() == [-1, -1]


@pytest.fixture
def tree_of_boxes(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    out = world.folder / "semantic_tree"
    run_semantic_tree(contributions, world.masks, out, SemanticTreeSettings())
    return world, out


def test_two_boxes_give_exactly_their_regions(tree_of_boxes):
    world, out = tree_of_boxes
    tree = SemanticTree.load(out, world.clip)
    # Nodes follow the first mask of each: view 0 misses "A bottom", so it comes after "B top".
    order = [0, 1, 2, 4, 3, 5, 6]
    assert tree.level.tolist() == [REGIONS[row][1] for row in order]
    names = [REGIONS[row][0] for row in order]
    parents = [names[parent] if parent >= 0 else None for parent in tree.parent]
    assert parents == [None, None, "A", "B", "A", "A top", "B"]
    for node, row in enumerate(order):
        member = (tree.node_of_gaussian[:, REGIONS[row][1] - 1] == node).reshape(HEIGHT, WIDTH)
        assert np.array_equal(member, region_mask(row)), REGIONS[row][0]
        assert tree.clip[node] @ world.region_vectors[row] > 0.99
    assert np.linalg.norm(tree.clip, axis=1) == pytest.approx(np.ones(7), abs=1e-5)
    assert tree.views.tolist() == [4, 4, 4, 3, 3, 3, 3]
    assert (tree.node_of_mask >= 0).all()
    assert tree.centroid[0] == pytest.approx([2.5, 3.5, 0], abs=0.2)
    assert tree.box[0][0] == pytest.approx([0, 0, 0], abs=0.01)
    assert tree.box[0][1] == pytest.approx([5, 7, 0], abs=0.01)
    assert (tree.quality > 0.7).all()


def test_children_and_ancestors_reach_past_missing_parts(tree_of_boxes):
    tree = SemanticTree.load(tree_of_boxes[1])
    assert tree.children_of(np.array([1])).tolist() == [3, 6]
    ancestors = tree.ancestors()
    assert ancestors[0].tolist() == [0, -1, -1]
    assert ancestors[3].tolist() == [1, 3, -1]
    assert ancestors[5].tolist() == [0, 2, 5]
    assert ancestors[6].tolist() == [1, -1, 6]  # straight under the whole
    orphan = replace(tree, parent=np.where(np.arange(7) == 2, -1, tree.parent).astype(np.int32))
    assert orphan.ancestors()[5].tolist() == [-1, 2, 5]


def test_readable_tree_and_counts(tree_of_boxes):
    _, out = tree_of_boxes
    assert read_index(out)["nodes"] == {"whole": 2, "part": 3, "subpart": 2}
    nodes = read_json(out / "tree.json")["nodes"]
    assert nodes[0]["level"] == Level.WHOLE.label
    assert nodes[0]["children"] == [2, 4]
    assert sum(node["gaussians"] for node in nodes if node["level"] == "whole") == NUM_GAUSSIANS


def test_second_run_writes_the_same_bytes(tree_of_boxes):
    world, out = tree_of_boxes
    before = sha256_of_path(out)
    run_semantic_tree(world.folder / "contributions", world.masks, out, SemanticTreeSettings())
    assert sha256_of_path(out) == before


def test_more_views_requested_than_there_are_leave_an_empty_tree(two_boxes_contributions, caplog):
    world, contributions = two_boxes_contributions
    out = world.folder / "empty"
    run_semantic_tree(contributions, world.masks, out, SemanticTreeSettings(min_views=5))
    assert len(SemanticTree.load(out)) == 0
    assert "has no node" in caplog.text


def test_masks_in_another_order_are_refused(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    reverse_masks(world, "002.png")
    with pytest.raises(
        MisalignedArtifactError, match=rf"{contributions} .*different masks \(view 002\.png\)"
    ):
        run_semantic_tree(contributions, world.masks, world.folder / "out", SemanticTreeSettings())


def test_vectors_of_masks_in_another_order_are_refused(tree_of_boxes):
    world, out = tree_of_boxes
    index = read_index(world.clip)
    index["views"]["002.png"]["masks_sha256"] = "0" * 64
    write_index(world.clip, index.pop("views"), **index)
    with pytest.raises(MisalignedArtifactError, match=rf"{world.clip} .*different masks \(view 002\.png\)"):
        SemanticTree.load(out, world.clip)


def test_a_node_has_the_mean_of_the_crops_that_have_vectors(tree_of_boxes):
    _, out = tree_of_boxes
    tree = SemanticTree.load(out)
    assert tree.clip.shape == (7, 0)
    rows = np.flatnonzero(tree.linked_node == 0)
    vectors = np.zeros((len(tree.linked_node), 2), np.float32)
    vectors[rows[0]], vectors[rows[1]] = (1, 0), (0, 1)  # the other masks of the node have none
    weighted = tree.crop_score[rows[:2]].astype(np.float64)
    assert tree.with_vectors(vectors).clip[0] == pytest.approx(weighted / np.linalg.norm(weighted))


def test_crops_score_the_root_of_their_area_times_their_fit(tree_of_boxes):
    tree = SemanticTree.load(tree_of_boxes[1])
    assert (tree.linked_node >= 0).all()
    whole = np.flatnonzero(tree.linked_node == 0)[0]  # 6 x 8 px; weights leak a little
    assert 0.8 * np.sqrt(48) < tree.crop_score[whole] < np.sqrt(48)


def test_vectors_of_another_tree_are_refused(tree_of_boxes):
    world, out = tree_of_boxes
    for view in world.regions:
        vectors = read_npy(world.clip / f"{view}.npy")
        write_npy(world.clip / f"{view}.npy", np.zeros_like(vectors))
    change_index(world.clip)
    with pytest.raises(MisalignedArtifactError, match=r"has no vector for some nodes of (.|\n)*7 of 7"):
        SemanticTree.load(out, world.clip)


def test_an_artifact_without_digests_is_refused(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    index = read_index(contributions)
    write_index(contributions, {view: {"masks": 6} for view in index.pop("views")}, **index)
    with pytest.raises(ArtifactError, match=r"is of another version\n *expected +masks_sha256 of every"):
        run_semantic_tree(contributions, world.masks, world.folder / "out", SemanticTreeSettings())
