"""Ranks of the crops of a node."""

import numpy as np

from hilsplat.semantic_tree.crops import RANKED, crop_ranks


def towards(*degrees: float) -> np.ndarray:
    turns = np.deg2rad(degrees)
    return np.stack([np.cos(turns), np.sin(turns), np.zeros(len(turns))], axis=1)


def test_a_worse_crop_from_another_side_comes_before_a_better_one_from_the_same():
    node = np.array([0, 0, 0, -1, 1], np.int32)
    score = np.array([4, 3, 1, 9, 1], np.float32)
    # 3 degrees beside the best one, the second keeps a tenth of its score
    assert crop_ranks(node, score, towards(0, 3, 90, 0, 0)).tolist() == [0, 2, 1, -1, 0]


def test_crops_from_one_place_are_ranked_by_score():
    node, score = np.zeros(4, np.int32), np.array([2, 4, 1, 3], np.float32)
    assert crop_ranks(node, score, towards(0, 0, 0, 0)).tolist() == [2, 0, 3, 1]


def test_a_node_has_a_limited_number_of_ranks():
    ranks = crop_ranks(np.zeros(50, np.int32), np.ones(50, np.float32), towards(*range(50)))
    assert sorted(ranks[ranks >= 0]) == list(range(RANKED))


def test_no_mask_has_no_rank():
    assert len(crop_ranks(np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros((0, 3)))) == 0
