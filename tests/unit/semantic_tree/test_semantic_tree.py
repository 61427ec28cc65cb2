"""Nodes of linked masks, and the tree of a world whose nodes are known."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.artifacts import read_index, read_json, read_npy, write_index, write_npy
from hilsplat.base.errors import MemoryLimitError, MisalignedArtifactError
from hilsplat.base.lineage import sha256_of_path
from hilsplat.semantic_tree import nodes
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.semantic_tree.linkage import mask_evidence
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.semantic_tree.view_pairs import ViewPairs, view_pairs
from hilsplat.settings import SemanticTreeSettings
from tests.unit.artifact_changes import change_index
from tests.unit.two_boxes_world import HEIGHT, NUM_GAUSSIANS, REGIONS, WIDTH, region_mask, reverse_masks


def test_gaussians_join_the_node_with_the_largest_share(monkeypatch):
    def joined(weights, cluster, view, mass, min_share) -> tuple[list[int], np.ndarray]:
        monkeypatch.setattr(nodes, "MIN_MEMBER_SHARE", min_share)
        S, mass = sp.csr_matrix(np.array(weights, np.float32)), np.array(mass, np.float32)
        masks = np.array(cluster), 2, S, np.array(view, np.int32)
        node, membership = nodes.gaussian_nodes(
            *masks, sp.csr_matrix(mass), mass.sum(axis=0, dtype=np.float64)
        )
        return node.tolist(), membership.tolist()

    # Gaussian 0 has 9 of 10 px in node 0 and 2 in node 1; Gaussian 1 has too little (2 of 10) in any
    weights = [[5, 1, 2], [4, 1, 2], [2, 0, 1]]
    found = joined(weights, [0, 0, 1], [0, 1, 1], [[5] * 3] * 2, 0.25)
    assert found == ([0, -1, 0], pytest.approx([0.9, 0, 0.4]))
    # node 0 has masks in all ten views, five of which show the Gaussian; node 1 in four, which all show it:
    # 5/10 * 5/(10 + 3) against 4/10 * 4/(4 + 3)
    views = [*range(10), *range(5, 9)]
    found = joined([[1]] * 5 + [[0]] * 5 + [[1]] * 4, [0] * 10 + [1] * 4, views, [[1]] * 10, 0.05)
    assert found == ([1], pytest.approx([0.4]))
    # on a tie, the lower node
    assert joined([[3], [3]], [1, 0], [0, 1], [[5]] * 2, 0.0)[0] == [0]
    # masks 0 and 1 of view 0 are node 0, twice the same 4 of 4 px of Gaussian 0; mask 3 is node 1: 5 of 6 px
    found = joined([[4, 2], [4, 0], [0, 2], [5, 3]], [0, 0, -1, 1], [0, 0, 0, 1], [[4] * 2, [6] * 2], 0.1)
    assert found == ([1, 1], pytest.approx([0.5, 0.3]))


def test_small_pieces_apart_from_their_node_leave_it():
    # two nodes on a line: node 0 at 0 to 39 and, one unit of mass in 52, at 200; node 1 beside the latter
    means = np.zeros((52, 3))
    means[:, 0] = [*range(40), 200, *range(201, 212)]
    node = np.array([0] * 41 + [1] * 11, np.int32)
    nearest, mass = nodes.nearest_gaussians(means, 1), np.full(52, 2.0)
    kept = nodes.without_strays(node, nearest, mass)
    assert kept.tolist() == node.tolist()  # one of forty is more than 2 %
    mass[40] = 1.0
    assert np.flatnonzero(nodes.without_strays(node, nearest, mass) != node).tolist() == [40]
    node[:] = -1
    assert (nodes.without_strays(node, nearest, mass) == -1).all()


def test_a_duplicate_cluster_is_not_a_node():
    # Four views of ten Gaussians: one mask of all (two views miss Gaussian 3), and in three of the views
    # one of the first four. Those are a cluster of their own and win Gaussian 3 alone, which none shows.
    view = np.array([0, 0, 1, 1, 2, 2, 3], np.int32)
    double = np.array([0, 1, 0, 1, 0, 1, 0], bool)
    masks = np.where(double[:, None], np.arange(10) < 4, np.ones((7, 1))).astype(np.float32)
    masks[:4, 3][~double[:4]] = 0
    mass, rows = sp.csr_matrix(np.ones((4, 10), np.float32)), np.arange(7)

    (found,) = nodes.linked_nodes(sp.csr_matrix(masks), mass, view, [rows], SemanticTreeSettings(), 1)
    assert found.of_mask.tolist() == [0, -1, 0, -1, 0, -1, 0]
    assert found.of_gaussian.tolist() == [0] * 10
    assert found.membership == pytest.approx(np.where(np.arange(10) == 3, 0.5, 1.0))
    assert len(found.quality) == 1

    masks[np.ix_([0, 2], range(4))] = 0  # now it wins all four, and is a node
    (found,) = nodes.linked_nodes(sp.csr_matrix(masks), mass, view, [rows], SemanticTreeSettings(), 1)
    assert found.of_gaussian.tolist() == [1] * 4 + [0] * 6


def test_a_whole_may_be_the_parent_of_a_subpart():
    node_of_gaussian = np.array([[0, 1, 2], [0, 1, 2], [0, -1, 3], [0, -1, 3], [-1, -1, 4]], np.int32)
    level = np.array([1, 2, 3, 3, 3], np.uint8)
    assert nodes.node_parents(node_of_gaussian, level, np.ones(5), 0.5).tolist() == [-1, 0, 1, 0, -1]
    # a cover of exactly the threshold is not enough
    half = np.array([[0, 1, -1], [-1, 1, -1]], np.int32)
    assert nodes.node_parents(half, np.array([1, 2], np.uint8), np.ones(2), 0.5).tolist() == [-1, -1]


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
    assert read_index(out)["nodes"] == {"whole": 2, "part": 3, "subpart": 2}
    listed = read_json(out / "tree.json")["nodes"]
    assert (listed[0]["level"], listed[0]["children"]) == ("whole", [2, 4])
    assert sum(node["gaussians"] for node in listed if node["level"] == "whole") == NUM_GAUSSIANS


def test_children_and_ancestors_of_nodes_without_a_part(tree_of_boxes):
    tree = SemanticTree.load(tree_of_boxes[1])
    assert tree.children_of(np.array([1])).tolist() == [3, 6]
    ancestors = tree.ancestors()
    assert ancestors[0].tolist() == [0, -1, -1]
    assert ancestors[3].tolist() == [1, 3, -1]
    assert ancestors[5].tolist() == [0, 2, 5]
    assert ancestors[6].tolist() == [1, -1, 6]  # straight under the whole
    orphan = replace(tree, parent=np.where(np.arange(7) == 2, -1, tree.parent).astype(np.int32))
    assert orphan.ancestors()[5].tolist() == [-1, 2, 5]


def test_a_rerun_writes_the_same_bytes_and_too_few_views_give_an_empty_tree(tree_of_boxes, caplog):
    world, out = tree_of_boxes
    before = sha256_of_path(out)
    run_semantic_tree(world.folder / "contributions", world.masks, out, SemanticTreeSettings())
    assert sha256_of_path(out) == before
    run_semantic_tree(world.folder / "contributions", world.masks, out, SemanticTreeSettings(min_views=5))
    assert len(SemanticTree.load(out)) == 0
    assert "has no nodes" in caplog.text


def test_levels_are_compared_one_by_one_if_memory_is_short(tree_of_boxes, monkeypatch):
    world, out = tree_of_boxes
    inputs = world.folder / "contributions", world.masks, world.folder / "short", SemanticTreeSettings(), 2
    at_once: list[int] = []

    def pairs_mib(counts: list[float], levels: int) -> float:
        at_once.append(levels)
        return 1000.0 * levels if len(at_once) > 1 else 5000.0  # the bound doesn't fit, the counted pairs do

    monkeypatch.setattr(nodes, "_pairs_mib", pairs_mib)
    run_semantic_tree(*inputs, memory_mib=1500.0)
    assert at_once == [2, 1, 2]
    assert sha256_of_path(world.folder / "short" / "tree.npz") == sha256_of_path(out / "tree.npz")
    with pytest.raises(MemoryLimitError, match=r"tree of 24 masks in 4 views(.|\n)*found +1.0 GiB"):
        run_semantic_tree(*inputs, memory_mib=1024.0)


def test_a_few_views_tell_the_number_of_pairs():
    """The sample's pairs, scaled by pairs of views, are those of all views if every view is alike."""
    num, masks = 40, 3
    visible = sp.csr_matrix(np.ones((num, 30), np.float32))
    shares = sp.csr_matrix(np.tile(np.kron(np.eye(masks), np.ones(10)), (num, 1)))
    view, pairs = np.repeat(np.arange(num, dtype=np.int32), masks), view_pairs(visible)

    def count(of: ViewPairs) -> int:
        return mask_evidence(shares, np.ones(30), visible, view, of, 0.2).num_pairs

    sampled = pairs.of_views(np.array([0, 13, 39]))
    assert len(sampled.partners) - num == 2 * (39 + 38 + 37)
    assert count(sampled) == masks * (39 + 38 + 37)
    assert count(pairs) == masks * num * (num - 1) // 2


def test_masks_in_another_order_are_refused(tree_of_boxes):
    world, out = tree_of_boxes
    contributions = world.folder / "contributions"
    index = read_index(world.clip)
    index["views"]["002.png"]["masks_sha256"] = "0" * 64
    write_index(world.clip, index.pop("views"), **index)
    with pytest.raises(
        MisalignedArtifactError, match=rf"{world.clip} was not made from the masks of view 002\.png"
    ):
        SemanticTree.load(out, world.clip)
    reverse_masks(world, "002.png")
    message = rf"{contributions} was not made from the masks of view 002\.png"
    with pytest.raises(MisalignedArtifactError, match=message):
        run_semantic_tree(contributions, world.masks, world.folder / "out", SemanticTreeSettings())


def test_a_node_has_the_mean_of_the_crops_that_have_vectors(tree_of_boxes):
    _, out = tree_of_boxes
    tree = SemanticTree.load(out)
    assert tree.clip.shape == (7, 0)
    rows = np.flatnonzero(tree.linked_node == 0)
    vectors = np.zeros((len(tree.linked_node), 2), np.float32)
    vectors[rows[0]], vectors[rows[1]] = (1, 0), (0, 1)  # the other masks of the node have none
    weighted = tree.crop_score[rows[:2]].astype(np.float64)
    assert tree.with_vectors(vectors).clip[0] == pytest.approx(weighted / np.linalg.norm(weighted))
    assert (tree.linked_node >= 0).all()
    # the root of the area (6 x 8 px) times the fit; weights leak a little
    assert 0.8 * np.sqrt(48) < tree.crop_score[rows[0]] < np.sqrt(48)


def test_vectors_of_another_tree_are_refused(tree_of_boxes):
    world, out = tree_of_boxes
    for view in world.regions:
        vectors = read_npy(world.clip / f"{view}.npy")
        write_npy(world.clip / f"{view}.npy", np.zeros_like(vectors))
    change_index(world.clip)
    with pytest.raises(MisalignedArtifactError, match=r"has no vector for some nodes of (.|\n)*7 of 7"):
        SemanticTree.load(out, world.clip)
