"""Prompts at the nodes of the key views."""

import numpy as np
import scipy.sparse as sp

from hilsplat.base.levels import Level
from hilsplat.segment.sam import point_grid
from hilsplat.semantic_tree.guided_masks import guided_points
from hilsplat.semantic_tree.view_nodes import ViewNodes


def test_each_node_is_prompted_in_its_middle_and_the_grid_only_where_nothing_is_explained():
    whole, part, subpart = (np.full((8, 12), -1, np.int32) for _ in range(3))
    whole[:, :] = 0
    part[6:8, 10:12] = 1  # 4 px: too small for a prompt
    subpart[1:6, 1:6] = 4  # its middle is pixel (3, 3)
    labels = {Level.WHOLE: whole, Level.PART: part, Level.SUBPART: subpart}
    points = guided_points(labels, point_grid(4), 5)
    assert (3.5, 3.5) in map(tuple, points)
    assert len(points) == 2 + 16 - 6  # nodes 0 and 4; grid points at x 1.5, 4.5 and y 1, 3, 5 are explained
    assert (4.5, 3.0) not in map(tuple, points)


def test_without_any_node_the_grid_is_prompted():
    nothing = dict.fromkeys(Level, np.full((4, 4), -1, np.int32))
    np.testing.assert_allclose(guided_points(nothing, point_grid(2), 1), point_grid(2) * 4)


def test_a_pixel_shows_the_node_that_makes_up_more_than_half_of_it():
    weights = sp.csr_matrix(np.array([[0.7, 0.3, 0], [0.5, 0.5, 0], [0, 0, 0], [0, 0.4, 0.6]], np.float32))
    shown = ViewNodes.of(weights, np.array([2, 5, -1], np.int32))
    assert shown.labels((2, 2)).tolist() == [[2, -1], [-1, -1]]
