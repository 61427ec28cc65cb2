"""3D measures of a tree against true nodes, by hand, and the tree's picture."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilsplat.base.levels import Level
from hilsplat.datasets.hierarchy import AnnotatedNode, HierarchyAnnotations
from hilsplat.query.names import NodeNames
from hilsplat.query.tree_picture import CELL_PX, GAP_PX, LABEL_PX, tree_picture
from hilsplat_world.diagnostics import tree_truth
from tests.unit.evaluate.plain_tree import plain_tree

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


def tree_of(node_of_gaussian, level, parent):
    return plain_tree(level, parent, node_of_gaussian, quality=np.full(len(level), 0.8, np.float32))


PERFECT = [[0, 2, -1]] * 2 + [[0, -1, -1]] * 2 + [[1, 3, -1]] * 2 + [[1, -1, -1]] * 2


def test_faults_are_counted_one_by_one():
    # The chest is split into nodes of 3 and 1 Gaussians; the larger also has one of the bear. The parent of
    # the head is the chest.
    nodes = [[0, 3, -1]] * 2 + [[0, -1, -1]] + [[1, -1, -1]] * 4 + [[2, -1, -1]]
    found = tree_truth.measure_tree(tree_of(nodes, [1, 1, 1, 2], [-1, -1, -1, 1]), VOTES, TRUTH)
    whole = found[Level.WHOLE]
    # bear: 3 of 4, IoU 3/4; chest: 3 shared of a union of 5
    values = [whole.precision, whole.recall, whole.mean_iou, whole.purity]
    assert values == pytest.approx([2 / 3, 1, (3 / 4 + 3 / 5) / 2, (3 + 3 + 1) / 8])
    part = found[Level.PART]
    assert (part.precision, part.recall, part.parent_accuracy) == (1, 0.5, 0)


def test_the_true_tree_is_perfect_in_the_table(tmp_path, monkeypatch):
    loaded = {
        "Scene": SimpleNamespace(name="s", views=lambda split: []),
        "HierarchyAnnotations": TRUTH,
        "SemanticTree": tree_of(PERFECT, [1, 1, 2, 2], [-1, -1, 0, 1]),
    }
    for name, value in loaded.items():
        monkeypatch.setattr(tree_truth, name, SimpleNamespace(load=lambda _, value=value: value))
    monkeypatch.setattr(tree_truth, "true_votes", lambda *_: VOTES)
    text = tree_truth.run_tree_truth(Path(), Path(), Path(), Path(), tmp_path / "tree.csv", 1)
    lines = (tmp_path / "tree.csv").read_text().splitlines()
    assert lines == [
        ",".join(tree_truth.COLUMNS),
        "s,whole,2,2,1.0000,1.0000,1.0000,1.0000,nan,0.8000",
        "s,part,2,2,1.0000,1.0000,1.0000,1.0000,1.0000,0.8000",
        "s,subpart,0,0,0.0000,0.0000,0.0000,0.0000,nan,0.0000",
    ]
    assert "| s | part | 2 | 2 | 1.0000 |" in text


def test_the_picture_has_a_row_of_crops_per_level_and_the_names_of_nodes(block_world):
    answers = block_world.answers
    without = tree_picture(answers)
    assert without.shape[0] > 3 * CELL_PX
    # the crops are there: more than the background and its lines
    assert len(np.unique(without.reshape(-1, 3), axis=0)) > 5
    longer = "a name that is far too long for the width of one crop"
    named = tree_picture(replace(answers, names=NodeNames({0: longer})))
    changed = np.argwhere((named != without).any(axis=2))
    height, width = np.ptp(changed, axis=0)
    assert 5 < height < LABEL_PX / 2 and CELL_PX / 2 < width < CELL_PX + GAP_PX
