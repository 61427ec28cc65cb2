"""3D measures of a tree against true nodes, by hand, and the tree's picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.levels import Level
from hilsplat.datasets.synthetic.hierarchy import AnnotatedNode, HierarchyAnnotations
from hilsplat.evaluate.diagnostics.tree_truth import measure_tree
from hilsplat.query.names import NodeNames
from hilsplat.query.tree_picture import CELL_PX, GAP_PX, LABEL_PX, tree_picture
from hilsplat.semantic_tree.tree import SemanticTree

TRUTH = HierarchyAnnotations(
    Path(),
    (
        AnnotatedNode(0, 1, -1, "bear"),
        AnnotatedNode(1, 1, -1, "chest"),
        AnnotatedNode(2, 2, 0, "head"),
        AnnotatedNode(3, 2, 1, "lid"),
    ),
    {},
)
# eight Gaussians: four of the bear (two of them its head), four of the chest (two of them its lid)
BEAR_HEAD, BEAR, CHEST_LID, CHEST = [1, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 1], [0, 1, 0, 0]
VOTES = np.array([BEAR_HEAD] * 2 + [BEAR] * 2 + [CHEST_LID] * 2 + [CHEST] * 2, float)


def tree_of(node_of_gaussian, level, parent) -> SemanticTree:
    """A tree with only the measured parts set."""
    num, nodes = len(level), np.array(node_of_gaussian, np.int32)
    return SemanticTree(
        level=np.array(level, np.uint8),
        parent=np.array(parent, np.int32),
        clip=np.ones((num, 2), np.float32),
        centroid=np.zeros((num, 3), np.float32),
        box=np.zeros((num, 2, 3), np.float32),
        oriented_box=np.zeros((num, 5, 3), np.float32),
        quality=np.full(num, 0.8, np.float32),
        views=np.ones(num, np.int32),
        node_of_gaussian=nodes,
        membership=np.ones(nodes.shape, np.float32),
        node_of_mask=np.zeros(0, np.int32),
        linked_node=np.zeros(0, np.int32),
        crop_score=np.zeros(0, np.float32),
        crop_rank=np.zeros(0, np.int32),
        view_area_px=np.ones((num, 1), np.float32),
        view_names=("000.png",),
        gaussians_sha256="",
        cameras_sha256="",
        min_weight=1 / 255,
    )


PERFECT = [[0, 2, -1]] * 2 + [[0, -1, -1]] * 2 + [[1, 3, -1]] * 2 + [[1, -1, -1]] * 2


def test_the_true_tree_is_perfect():
    found = measure_tree(tree_of(PERFECT, [1, 1, 2, 2], [-1, -1, 0, 1]), VOTES, TRUTH)
    for level in (Level.WHOLE, Level.PART):
        one = found[level]
        assert (one.precision, one.recall, one.mean_iou, one.purity) == (1, 1, 1, 1)
        assert (one.nodes, one.true_nodes) == (2, 2)
        assert one.view_consistency == pytest.approx(0.8)
    assert found[Level.PART].parent_accuracy == 1
    assert np.isnan(found[Level.WHOLE].parent_accuracy)
    assert found[Level.SUBPART].true_nodes == 0


def test_faults_are_counted_one_by_one():
    # the chest falls into two nodes of 3 and 1; one Gaussian of the bear is in its larger one; the head
    # hangs under the chest
    nodes = [
        [0, 3, -1],
        [0, 3, -1],
        [0, -1, -1],
        [1, -1, -1],
        [1, -1, -1],
        [1, -1, -1],
        [1, -1, -1],
        [2, -1, -1],
    ]
    found = measure_tree(tree_of(nodes, [1, 1, 1, 2], [-1, -1, -1, 1]), VOTES, TRUTH)
    whole = found[Level.WHOLE]
    # bear: 3 of 4, IoU 3/4; chest: 3 shared of a union of 5
    assert whole.precision == pytest.approx(2 / 3)
    assert whole.recall == 1
    assert whole.mean_iou == pytest.approx((3 / 4 + 3 / 5) / 2)
    assert whole.purity == pytest.approx((3 + 3 + 1) / 8)
    part = found[Level.PART]
    assert (part.precision, part.recall, part.parent_accuracy) == (1, 0.5, 0)


def test_the_picture_has_a_row_of_crops_per_level(block_world):
    picture = tree_picture(block_world.answers)
    assert picture.dtype == np.uint8
    assert picture.shape[0] > 3 * CELL_PX
    # the crops are there: more than the background and its lines
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 5


def test_the_picture_has_the_names_of_nodes(block_world):
    answers = block_world.answers
    without = tree_picture(answers)
    longer = "a name that is far too long for the width of one crop"
    named = tree_picture(replace(answers, names=NodeNames({0: longer})))
    changed = np.argwhere((named != without).any(axis=2))
    height, width = np.ptp(changed, axis=0)
    assert 5 < height < LABEL_PX / 2 and CELL_PX / 2 < width < CELL_PX + GAP_PX
