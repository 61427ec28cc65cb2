"""Nodes from clustered features: merged and nested clusters, and the stage on two boxes."""

from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import Level
from hilsplat.contributions.rows import Contributions
from hilsplat.methods.feature_tree import merge_distances, nested_clusters, run_feature_tree
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import FieldSettings, SemanticTreeSettings
from tests.unit.two_boxes_world import reverse_masks

LOSSES = FieldSettings(
    weight_clustering=1.0, weight_instance=0.3, weight_part=0.0, instance_mode="coverage_tree", min_mask_px=4
)


def blobs(*centres, each=50, spread=0.02):
    rng = np.random.default_rng(0)
    return np.concatenate([rng.normal(centre, spread, (each, 2)) for centre in centres]).astype(np.float32)


def test_clusters_join_below_the_distance_and_stay_apart_above_it():
    rows = np.repeat(blobs((0, 0), (0.3, 0), (3, 0))[:, None], 3, axis=1)
    found = nested_clusters(rows, (0.5, 0.1, 0.1), 0).reshape(3, 50, 3)
    assert [len(np.unique(each[:, 0])) for each in found] == [1, 1, 1]
    assert found[0, 0, 0] == found[1, 0, 0] != found[2, 0, 0]
    assert len(np.unique(found[:, :, 1])) == 3
    assert nested_clusters(rows[:1], (0.5, 0.1, 0.1), 0).tolist() == [[0, 0, 0]]


def test_the_distance_is_half_the_median_between_masks_of_one_parent():
    sizes = np.full(6, 5)
    view, mask = np.array([0, 0, 0, 0, 0, 1], np.int32), np.array([0, 1, 2, 3, 4, 0], np.int32)
    level = np.array([1, 1, 2, 2, 2, 1], np.uint8)
    contributions = Contributions(Path(), ("a", "b"), 3, "", "", 0.0, view, mask, level, sizes, sizes, sizes)
    parents = {"a": np.array([-1, -1, 0, 0, 1]), "b": np.array([-1])}
    means = np.array([[0, 0], [4, 0], [1, 0], [1, 1], [9, 0], [50, 0]], np.float32)
    assert merge_distances(means, contributions, parents) == (2.0, 0.5, np.inf)


def test_finer_clusters_are_inside_coarser_ones_and_unseen_gaussians_have_none():
    whole = blobs((0, 0), (3, 0))
    part = np.concatenate([blobs((0, 0), (0, 2), each=25), blobs((0, 0), (0, 2), each=25)])
    features = np.stack([whole, part, np.full_like(part, np.nan)], axis=1)
    features[0, 1] = np.nan
    found = nested_clusters(features, (0.5, 0.5, 0.5), 0)
    assert found[0, 1] == -1 and (found[:, 2] == -1).all()
    # two parts in each whole, although the parts of both wholes have the same features
    assert len(np.unique(found[1:, 1])) == 4
    for cluster in np.unique(found[1:, 1]):
        assert len(np.unique(found[1:][found[1:, 1] == cluster, 0])) == 1


def test_gaussians_in_no_coarser_cluster_share_none_of_its_finer_clusters():
    features = np.full((4, 3, 2), np.nan, np.float32)
    features[:, 2] = 0
    features[:2, :2] = 0  # the others are in no whole and no part
    assert nested_clusters(features, (0.5, 0.5, 0.5), 0).tolist() == [[0, 0, 1]] * 2 + [[-1, -1, 0]] * 2


def test_l_h_alone_is_minimised(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    settings = SemanticTreeSettings(evidence="features", feature_size=3)
    alone = LOSSES.model_copy(update={"weight_instance": 0.0})
    run_feature_tree(
        contributions, world.masks, world.coverage_tree, world.folder / "alone", settings, alone, 0, 1
    )
    assert len(SemanticTree.load(world.folder / "alone").nodes_of(Level.WHOLE)) == 2


def test_the_stage_finds_the_boxes_and_the_same_bytes_on_any_number_of_threads(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    settings = SemanticTreeSettings(evidence="features", feature_size=3)
    parts = (contributions, world.masks, world.coverage_tree)
    for threads in (1, 2):
        run_feature_tree(*parts, world.folder / f"tree{threads}", settings, LOSSES, 0, threads)
    found = SemanticTree.load(world.folder / "tree1")
    assert (world.folder / "tree1/tree.npz").read_bytes() == (world.folder / "tree2/tree.npz").read_bytes()
    wholes = found.nodes_of(Level.WHOLE)
    assert len(wholes) == 2
    own = found.node_of_gaussian[:, 0].reshape(8, 12)
    assert len(np.unique(own[:, 1:5])) == len(np.unique(own[:, 7:11])) == 1  # inside, away from the border
    assert own[0, 2] != own[0, 9]
    reverse_masks(world, "001.png")
    with pytest.raises(MisalignedArtifactError):
        run_feature_tree(*parts, world.folder / "tree3", settings, LOSSES, 0, 1)
