"""Morton order: neighbours in space are neighbours in memory."""

import numpy as np

from hilsplat.splat.gaussians import morton_order


def test_a_cube_is_walked_octant_by_octant():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    walked = corners[morton_order(corners)].tolist()
    assert walked[:4] == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert [point[2] for point in walked] == [0] * 4 + [1] * 4


def test_neighbours_lie_close_together_despite_a_point_far_away():
    rng = np.random.default_rng(0)
    points = rng.random((4096, 3)).astype(np.float32)
    points[0] = 1e6
    order = morton_order(points)
    assert sorted(order.tolist()) == list(range(4096))
    steps = np.linalg.norm(np.diff(points[order[order != 0]], axis=0), axis=1)
    assert np.median(steps) < 0.1  # 0.66 in random order


def test_equal_points_keep_their_order_and_none_is_fine():
    assert morton_order(np.zeros((5, 3), np.float32)).tolist() == [0, 1, 2, 3, 4]
    assert morton_order(np.zeros((0, 3), np.float32)).tolist() == []
