"""The coverage tree of a view (paper, Sec. III-B)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilsplat.base.errors import EmptyMaskError
from hilsplat.base.levels import NONE
from hilsplat.segment.coverage import coverage_parents, coverage_tree, depths
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import CoverageTreeSettings

shapes = st.tuples(st.integers(1, 8), st.just(3), st.just(4))
nonempty_masks = hnp.arrays(bool, shapes).filter(lambda masks: masks.any(axis=(1, 2)).all())


def rows(*texts: str) -> np.ndarray:
    """Masks of one image row: `#` inside, `.` outside."""
    return np.array([[[letter == "#" for letter in text]] for text in texts])


def test_the_smallest_cover_is_the_parent():
    masks = rows("##########", "#####.....", "##........")
    assert coverage_parents(masks, theta=0.9).tolist() == [NONE, 0, 1]


def test_nine_tenths_exactly_is_not_more_than_theta():
    # 9 of the first mask's 10 px lie in the second: 0.9 > 0.9 is false
    assert coverage_parents(rows("##########....", ".#############"), theta=0.9).tolist() == [NONE, NONE]
    # 9 of the second mask's 13 px lie in the first: 0.69 < 0.85
    assert coverage_parents(rows("##########....", ".#############"), theta=0.85).tolist() == [1, NONE]
    # theta below 0.69 asks that less of the cover lies in the child
    assert coverage_parents(rows("##########....", ".#############"), theta=0.65).tolist() == [NONE, NONE]


def test_of_two_equally_small_covers_the_lower_row_wins():
    assert coverage_parents(rows("####", "####", "#..."), theta=0.9).tolist() == [NONE, NONE, 0]


def test_a_parent_of_the_same_level_is_refused_when_levels_count():
    masks = rows("##########", "#####.....", "##........")
    level = np.array([1, 3, 3], dtype=np.uint8)
    assert coverage_parents(masks, 0.9, level).tolist() == [NONE, 0, 0]


def test_a_subpart_may_hang_directly_under_a_whole():
    level = np.array([3, 1], dtype=np.uint8)
    assert coverage_parents(rows("##...", "#####"), 0.9, level).tolist() == [1, NONE]


def test_the_smallest_cover_wins_even_where_it_is_the_coarser_one():
    masks = rows("##########", "######....", "##........")
    level = np.array([2, 1, 3], dtype=np.uint8)
    assert coverage_parents(masks, 0.9, level)[2] == 1


def test_empty_mask_is_named():
    with pytest.raises(EmptyMaskError, match=r"masks \[1\] of 2"):
        coverage_parents(rows("##", ".."), theta=0.9)


@given(nonempty_masks, st.floats(0.51, 0.99), st.booleans(), st.data())
def test_parents_form_a_forest_of_growing_masks(masks, theta, with_levels, data):
    level = None
    if with_levels:
        level = data.draw(hnp.arrays(np.uint8, len(masks), elements=st.integers(1, 3)))
    parents = coverage_parents(masks, theta, level)
    area_px = masks.sum(axis=(1, 2))
    children = np.flatnonzero(parents != NONE)
    assert (area_px[parents[children]] > area_px[children]).all()
    if level is not None:
        assert (level[parents[children]] < level[children]).all()
    depth = depths(parents)
    assert (depth[children] == depth[parents[children]] + 1).all()
    assert (depth[parents == NONE] == 1).all()


@given(nonempty_masks, st.sampled_from(["coarser", "any"]))
def test_tree_from_runs_equals_tree_from_pixels(masks, parents):
    level = (np.arange(len(masks)) % 3 + 1).astype(np.uint8)
    scores = np.ones(len(masks), np.float32)
    packed = HierarchicalMasks.from_dense(masks, level, scores, scores)
    parent, _ = coverage_tree(packed, CoverageTreeSettings(theta=0.8, parents=parents))
    expected = coverage_parents(masks, 0.8, level if parents == "coarser" else None)
    np.testing.assert_array_equal(parent, expected)


def test_a_view_without_masks_has_an_empty_tree():
    assert coverage_parents(np.zeros((0, 2, 2), bool), 0.9).shape == (0,)
    parent, depth = coverage_tree(HierarchicalMasks.concatenate([], (2, 2)), CoverageTreeSettings())
    assert parent.shape == depth.shape == (0,)
