"""Boxes, nesting, crops, prompts, pixels and exports of nodes, by hand."""

import numpy as np
import pytest
import scipy.sparse as sp
from plyfile import PlyData

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import Level
from hilsplat.base.lineage import sha256_of_file
from hilsplat.segment.sam import point_grid
from hilsplat.semantic_tree.build import MAX_RANKED, crop_ranks
from hilsplat.semantic_tree.export import write_selection_ply, write_tree_ply
from hilsplat.semantic_tree.guided_masks import guided_points
from hilsplat.semantic_tree.nodes import nest_nodes, renumbered_without_empty
from hilsplat.semantic_tree.tree import OrientedBox, ViewNodes, oriented_box
from hilsplat.splat.gaussians import base_rgb
from hilsplat.splat.ply import load_ply, save_ply
from tests.unit.evaluate.plain_tree import plain_tree
from tests.unit.round_gaussians import round_gaussians


def test_the_box_of_a_rotated_brick_is_parallel_to_it():
    rng = np.random.default_rng(0)
    angle = np.deg2rad(30)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    brick = rng.uniform(-0.5, 0.5, (20_000, 3)) * [4.0, 2.0, 1.0]
    box = OrientedBox.from_array(oriented_box(brick @ turn.T + [1, 2, 3], np.ones(20_000)))
    # 2nd to 98th percentile of an even spread: 96 % of each side
    assert box.size == pytest.approx((3.84, 1.92, 0.96), abs=0.05)
    assert box.centre == pytest.approx((1, 2, 3), abs=0.05)
    axes = np.array(box.axes)
    assert np.abs(axes[0] @ turn[:, 0]) > 0.999
    assert np.linalg.det(axes) == pytest.approx(1, abs=1e-5)
    corners = box.corners()
    assert np.linalg.norm(np.ptp((corners - box.centre) @ axes.T, axis=0) - box.size) < 1e-6


def test_children_become_subsets_of_their_parents():
    level = np.array([1, 1, 2, 3], np.uint8)
    parent = np.array([-1, -1, 0, 2], np.int32)  # 0 > 2 > 3, and another whole 1
    before = np.array(
        [
            [0, 2, 3],  # already nested
            [-1, 2, -1],  # only the part holds it: joins the whole
            [1, 2, -1],  # another whole holds it: leaves the part
            [-1, -1, 3],  # only the subpart holds it: joins part and whole
            [1, -1, 3],  # another whole holds it: leaves the subpart
            [1, -1, -1],
        ],
        np.int32,
    )
    after = nest_nodes(before, level, parent)
    expected = [[0, 2, 3], [0, 2, -1], [1, -1, -1], [0, 2, 3], [1, -1, -1], [1, -1, -1]]
    assert after.tolist() == expected
    assert np.array_equal(nest_nodes(after, level, parent), after)


def test_pixels_of_nodes_equal_the_product_with_all_weights():
    rng = np.random.default_rng(1)
    weights = sp.random(50, 20, 0.3, random_state=rng, dtype=np.float32, format="csr")
    weights = sp.csr_matrix(weights.multiply(1 / np.maximum(weights.sum(axis=1), 1e-9)), dtype=np.float32)
    node = rng.integers(-1, 4, 20).astype(np.int32)
    shown = ViewNodes.of(weights, node)
    values = rng.random(4).astype(np.float32)
    expected = weights @ np.where(node >= 0, values[node], np.float32(0.1))
    covered = np.diff(weights.indptr) > 0
    blended = shown.blend(values, 0.1)
    assert blended[covered] == pytest.approx(expected[covered], abs=1e-6)
    assert (blended[~covered] == blended[covered].min()).all()
    chosen = np.array([True, False, True, False])
    member = np.where(node >= 0, chosen[node], False).astype(np.float32)
    total = weights @ member
    clear = np.abs(total - 0.5) > 1e-5
    assert np.array_equal(shown.mask(chosen)[clear], (total > 0.5)[clear])


def test_a_pixel_shows_the_node_that_makes_up_more_than_half_of_it():
    weights = sp.csr_matrix(np.array([[0.7, 0.3, 0], [0.5, 0.5, 0], [0, 0, 0], [0, 0.4, 0.6]], np.float32))
    shown = ViewNodes.of(weights, np.array([2, 5, -1], np.int32))
    assert shown.labels((2, 2)).tolist() == [[2, -1], [-1, -1]]


def test_an_exported_tree_or_selection_is_a_valid_3dgs_ply(tmp_path):
    ply, out, means = tmp_path / "gaussians.ply", tmp_path / "tree.ply", np.arange(12.0).reshape(4, 3)
    save_ply(ply, round_gaussians(means))
    nodes = np.array([[0, -1, 3], [0, 2, -1], [1, -1, -1], [-1, -1, -1]], np.int32)
    tree = plain_tree([1, 1, 2, 3], [-1, -1, 0, 0], nodes, gaussians_sha256=sha256_of_file(ply))
    write_tree_ply(ply, tree, out)
    vertex = PlyData.read(out)["vertex"]
    for level in Level:
        assert np.array_equal(vertex[f"node_{level.label}"], nodes[:, level.index])
    np.testing.assert_array_equal(load_ply(out).means, means)
    write_selection_ply(ply, np.array([1, 3]), tmp_path / "selection.ply", np.ones(2, np.int32))
    selected = load_ply(tmp_path / "selection.ply")
    assert selected.means[:, 0].tolist() == [3, 9]
    for name, expected in zip(("red", "green", "blue"), base_rgb(selected.sh).T, strict=True):
        found = PlyData.read(tmp_path / "selection.ply")["vertex"][name]
        assert found.dtype == np.uint8 and np.array_equal(found, np.rint(255 * expected))
    save_ply(ply, round_gaussians(means + 1))  # as many Gaussians
    with pytest.raises(MisalignedArtifactError, match=r"semantic tree was not made from .*\.ply"):
        write_tree_ply(ply, tree, out)


def test_a_node_that_nesting_emptied_is_dropped_and_the_others_keep_their_order():
    # wholes 0 and 1, parts 2 and 3; part 2 belongs to whole 0 and is entirely inside whole 1
    before = np.array([[0, -1, -1], [1, 2, -1], [1, 3, -1]], np.int32)
    level, parent = np.array([1, 1, 2, 2], np.uint8), np.array([-1, -1, 0, 1], np.int32)
    after = nest_nodes(before, level, parent)
    renumber = renumbered_without_empty(after, len(level))
    assert renumber.tolist() == [0, 1, -1, 2, -1]
    assert renumber[after].tolist() == [[0, -1, -1], [1, -1, -1], [1, 2, -1]]
    assert renumber[parent[[0, 1, 3]]].tolist() == [-1, -1, 1]


def towards(*degrees: float) -> np.ndarray:
    turns = np.deg2rad(degrees)
    return np.stack([np.cos(turns), np.sin(turns), np.zeros(len(turns))], axis=1)


@pytest.mark.parametrize(
    ("node", "score", "degrees", "ranks"),
    [
        # 3 degrees beside the best one, the second keeps a tenth of its score
        ([0, 0, 0, -1, 1], [4, 3, 1, 9, 1], [0, 3, 90, 0, 0], [0, 2, 1, -1, 0]),
        ([0, 0, 0, 0], [2, 4, 1, 3], [0, 0, 0, 0], [2, 0, 3, 1]),
        ([], [], [], []),
    ],
    ids=["other side first", "one side: by score", "no mask"],
)
def test_crops_are_ranked_by_score_and_side_up_to_a_limit(node, score, degrees, ranks):
    found = crop_ranks(np.array(node, np.int32), np.array(score, np.float32), towards(*degrees))
    assert found.tolist() == ranks
    many = crop_ranks(np.zeros(50, np.int32), np.ones(50, np.float32), towards(*range(50)))
    assert sorted(many[many >= 0]) == list(range(MAX_RANKED))


def test_nodes_are_prompted_in_their_middle_and_the_grid_elsewhere():
    whole, part, subpart = (np.full((8, 12), -1, np.int32) for _ in range(3))
    whole[:, :] = 0
    part[6:8, 10:12] = 1  # 4 px: too small for a prompt
    subpart[1:6, 1:6] = 4  # its middle is pixel (3, 3)
    labels = {Level.WHOLE: whole, Level.PART: part, Level.SUBPART: subpart}
    points = guided_points(labels, point_grid(4), 5)
    assert (3.5, 3.5) in map(tuple, points)
    # nodes 0 and 4; the subpart covers the grid points at x 1.5, 4.5 and y 1, 3, 5
    assert len(points) == 2 + 16 - 6
    assert (4.5, 3.0) not in map(tuple, points)
    nothing = dict.fromkeys(Level, np.full((4, 4), -1, np.int32))
    np.testing.assert_allclose(guided_points(nothing, point_grid(2), 1), point_grid(2) * 4)
