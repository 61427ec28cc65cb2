"""Linking masks, and the tree of a world whose nodes are known."""

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.artifacts import read_index, read_json, sha256_of_path, write_index
from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import Level
from hilsplat.language.semantic_tree import (
    SemanticTree,
    gaussian_nodes,
    mask_evidence,
    node_parents,
    pooled_linkage,
    run_semantic_tree,
)
from hilsplat.settings import SemanticTreeSettings
from tests.unit.language.two_boxes_world import HEIGHT, NUM_GAUSSIANS, REGIONS, WIDTH, region_mask


def test_evidence_counts_only_gaussians_both_views_see():
    # three Gaussians; view 0 sees 0 and 1, view 1 sees 1 and 2
    visible = np.array([[True, True, False], [False, True, True]])
    shares = sp.csr_matrix(np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.5]]))
    intersection, union = mask_evidence(
        shares, np.ones(3), visible, np.array([0, 1], np.int32), 0.2, "tanimoto"
    )
    # on Gaussian 1 both agree fully: intersection 1, union 1 + 1 - 1
    assert intersection[0, 1] == pytest.approx(1)
    assert union[0, 1] == pytest.approx(1)


@pytest.mark.parametrize(("overlap", "iou"), [("tanimoto", 1.0), ("soft", 0.09 / 0.51)])
def test_a_blurred_region_agrees_with_itself_only_by_tanimoto(overlap, iou):
    visible, shares = np.ones((2, 1), bool), sp.csr_matrix(np.array([[0.3], [0.3]]))
    view = np.array([0, 1], np.int32)
    intersection, union = mask_evidence(shares, np.ones(1), visible, view, 0.2, overlap)
    assert intersection[0, 1] / union[0, 1] == pytest.approx(iou)


def test_masks_of_one_view_are_evidence_against_a_link():
    visible = np.ones((1, 2), bool)
    shares = sp.csr_matrix(np.array([[1.0, 0.0], [1.0, 1.0]]))
    intersection, union = mask_evidence(shares, np.ones(2), visible, np.zeros(2, np.int32), 0.2, "tanimoto")
    assert intersection[0, 1] == 0
    assert union[0, 1] == pytest.approx(3)  # sizes 1 and 2


def test_masks_that_hardly_see_each_other_are_no_evidence():
    visible = np.ones((2, 11), bool)
    visible[0, 5:], visible[1, :4] = False, False  # common: Gaussian 4 alone
    shares = sp.csr_matrix(np.where(visible, 1.0, 0.0))
    view = np.array([0, 1], np.int32)
    assert mask_evidence(shares, np.ones(11), visible, view, 0.1, "soft")[1][0, 1] == pytest.approx(1)
    assert mask_evidence(shares, np.ones(11), visible, view, 0.25, "soft")[1][0, 1] == 0


def test_linkage_pools_intersections_over_unions():
    # 0 and 1 agree by 0.8; together they agree with 2 by (3 + 0) / (10 + 5) = 0.2
    intersection = np.array([[0, 8, 3], [8, 0, 0], [3, 0, 0]], float)
    union = np.array([[0, 10, 10], [10, 0, 5], [10, 5, 0]], float)
    cluster, quality = pooled_linkage(intersection, union, 0.21)
    assert cluster.tolist() == [0, 0, 1]
    assert quality.tolist() == pytest.approx([0.8, 0.0])
    cluster, quality = pooled_linkage(intersection, union, 0.19)
    assert cluster.tolist() == [0, 0, 0]
    assert quality.tolist() == pytest.approx([11 / 25])


def test_linkage_of_equal_pairs_takes_the_lowest_rows():
    # 0-1 and 1-2 are equally good; joining 0-1 leaves 2 at 1 / 4 with the pair
    intersection = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], float)
    union = np.array([[0, 2, 2], [2, 0, 2], [2, 2, 0]], float)
    assert pooled_linkage(intersection, union, 0.3)[0].tolist() == [0, 0, 1]


def brute_linkage(intersection, union, threshold):
    clusters = [[row] for row in range(len(intersection))]
    while True:
        best, pair = -1.0, None
        for a in range(len(clusters)):
            for b in range(a + 1, len(clusters)):
                grid = np.ix_(clusters[a], clusters[b])
                if union[grid].sum() > 0:
                    value = intersection[grid].sum() / union[grid].sum()
                    if value > best + 1e-12:
                        best, pair = value, (a, b)
        if pair is None or best < threshold:
            return sorted(sorted(cluster) for cluster in clusters)
        clusters[pair[0]] += clusters.pop(pair[1])


@pytest.mark.parametrize("seed", range(5))
def test_linkage_equals_a_search_over_all_pairs(seed):
    rng = np.random.default_rng(seed)
    union = rng.uniform(1, 2, (14, 14)) * (rng.random((14, 14)) < 0.7)
    union = np.triu(union, 1) + np.triu(union, 1).T
    intersection = np.triu(union * rng.random((14, 14)) ** 2, 1)
    intersection = intersection + intersection.T
    cluster, _ = pooled_linkage(intersection, union, 0.3)
    found = sorted(sorted(np.flatnonzero(cluster == c).tolist()) for c in range(cluster.max() + 1))
    assert found == brute_linkage(intersection, union, 0.3)


def test_gaussians_join_the_node_with_the_largest_share():
    shares = sp.csr_matrix(np.array([[0.5, 0.1, 0.3], [0.4, 0.1, 0.0], [0.2, 0.0, 0.3]]))
    # nodes: masks 0 and 1 are node 0, mask 2 is node 1
    node = gaussian_nodes(np.array([0, 0, 1]), 2, shares, 0.25)
    # 0.9 against 0.2; 0.2 is too little; a tie goes to the lower node
    assert node.tolist() == [0, -1, 0]


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
    run_semantic_tree(contributions, world.masks, world.clip, out, SemanticTreeSettings())
    return world, out


def test_two_boxes_give_exactly_their_regions(tree_of_boxes):
    world, out = tree_of_boxes
    tree = SemanticTree.load(out)
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


def test_descendants_reach_past_missing_parts(tree_of_boxes):
    tree = SemanticTree.load(tree_of_boxes[1])
    assert tree.children_of(np.array([1])).tolist() == [3, 6]
    assert tree.descendants_of(np.array([0])).tolist() == [2, 4, 5]


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
    run_semantic_tree(world.folder / "contributions", world.masks, world.clip, out, SemanticTreeSettings())
    assert sha256_of_path(out) == before


def test_soft_overlap_sees_less_agreement_where_gaussians_cross_borders(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    quality = {}
    for overlap in ("tanimoto", "soft"):
        out = world.folder / overlap
        settings = SemanticTreeSettings(overlap=overlap, link_threshold=0.12)
        run_semantic_tree(contributions, world.masks, world.clip, out, settings)
        quality[overlap] = SemanticTree.load(out).quality
    assert (quality["soft"] < quality["tanimoto"]).all()


def test_more_views_asked_for_than_there_are_leave_an_empty_tree(two_boxes_contributions, caplog):
    world, contributions = two_boxes_contributions
    out = world.folder / "empty"
    run_semantic_tree(contributions, world.masks, world.clip, out, SemanticTreeSettings(min_views=5))
    assert len(SemanticTree.load(out)) == 0
    assert "has no node" in caplog.text


def test_other_masks_are_refused(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    write_index(world.masks, {}, changed=True)
    with pytest.raises(MisalignedArtifactError, match="belong to other masks"):
        run_semantic_tree(
            contributions, world.masks, world.clip, world.folder / "out", SemanticTreeSettings()
        )
