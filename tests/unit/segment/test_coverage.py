"""The coverage tree of a view (paper, Sec. III-B)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilsplat.base.errors import EmptyMaskError
from hilsplat.base.levels import NONE
from hilsplat.segment.coverage import coverage_parents, coverage_tree, depths, with_tree_levels
from hilsplat.segment.masks import HierarchicalMasks

shapes = st.tuples(st.integers(1, 8), st.just(3), st.just(4))
nonempty_masks = hnp.arrays(bool, shapes).filter(lambda masks: masks.any(axis=(1, 2)).all())


def rows(*texts: str) -> np.ndarray:
    """Masks of one image row: `#` inside, `.` outside."""
    return np.array([[[letter == "#" for letter in text]] for text in texts])


def parents_of(masks: np.ndarray, theta: float = 0.9, level: list[int] | None = None) -> list[int]:
    """`coverage_parents` of dense masks; without levels each row is coarser than the next."""
    pixels = masks.reshape(len(masks), -1).astype(np.int64)
    levels = np.arange(1, len(masks) + 1) if level is None else level
    return coverage_parents(pixels @ pixels.T, np.array(levels, np.uint8), theta).tolist()


def parents_by_loop(masks: np.ndarray, theta: float, level: np.ndarray) -> list[int]:
    """The paper's conditions for every pair of masks, written out."""
    found = []
    for a, mask in enumerate(masks):
        covers = [
            (int(cover.sum()), b)
            for b, cover in enumerate(masks)
            if level[b] < level[a]
            and (mask & cover).sum() / mask.sum() > theta
            and (mask & cover).sum() / cover.sum() < theta
        ]
        found.append(min(covers)[1] if covers else NONE)
    return found


def test_the_smallest_cover_is_the_parent():
    assert parents_of(rows("##########", "#####.....", "##........")) == [NONE, 0, 1]


def test_nine_tenths_exactly_is_not_more_than_theta():
    # 9 of the last mask's 10 px lie in the first: 0.9 > 0.9 is false
    masks = rows(".#############", "##########....")
    assert parents_of(masks, theta=0.9) == [NONE, NONE]
    # 9 of the first mask's 13 px lie in the last: 0.69 < 0.85
    assert parents_of(masks, theta=0.85) == [NONE, 0]
    # theta below 0.69 asks that less of the cover lies in the child
    assert parents_of(masks, theta=0.65) == [NONE, NONE]


def test_of_two_equally_small_covers_the_lower_row_wins():
    assert parents_of(rows("####", "####", "#..."), level=[1, 1, 2]) == [NONE, NONE, 0]


def test_a_parent_of_the_same_level_is_refused():
    assert parents_of(rows("##########", "#####.....", "##........"), level=[1, 3, 3]) == [NONE, 0, 0]


def test_a_subpart_may_hang_directly_under_a_whole():
    assert parents_of(rows("##...", "#####"), level=[3, 1]) == [1, NONE]


def test_the_smallest_cover_wins_even_if_it_is_the_coarser_one():
    assert parents_of(rows("##########", "######....", "##........"), level=[2, 1, 3])[2] == 1


def test_empty_mask_is_named():
    with pytest.raises(EmptyMaskError, match=r"masks \[1\] of 2"):
        parents_of(rows("##", ".."))


@given(nonempty_masks, st.floats(0.51, 0.99), st.data())
def test_parents_form_a_forest_of_growing_masks(masks, theta, data):
    level = data.draw(hnp.arrays(np.uint8, len(masks), elements=st.integers(1, 3)))
    parents = np.array(parents_of(masks, theta, level.tolist()), np.int32)
    area_px = masks.sum(axis=(1, 2))
    children = np.flatnonzero(parents != NONE)
    assert (area_px[parents[children]] > area_px[children]).all()
    assert (level[parents[children]] < level[children]).all()
    depth = depths(parents)
    assert (depth[children] == depth[parents[children]] + 1).all()
    assert (depth[parents == NONE] == 1).all()


@given(nonempty_masks, st.data())
def test_the_tree_of_run_lengths_equals_a_loop_over_pairs(masks, data):
    level = data.draw(hnp.arrays(np.uint8, len(masks), elements=st.integers(1, 3)))
    scores = np.ones(len(masks), np.float32)
    packed = HierarchicalMasks.from_dense(masks, level, scores, scores)
    parent, depth = coverage_tree(packed, theta=0.8)
    assert parent.tolist() == parents_by_loop(masks, 0.8, level)
    np.testing.assert_array_equal(depth, depths(parent))


def test_a_view_without_masks_has_an_empty_tree():
    parent, depth = coverage_tree(HierarchicalMasks.concatenate([], (2, 2)), theta=0.9)
    assert parent.shape == depth.shape == (0,)


def test_levels_by_the_tree_are_depths_whatever_head_made_a_mask():
    masks = rows("##########", "######....", "###.......", "##........", ".......##.")
    found = HierarchicalMasks.from_dense(
        masks, np.array([3, 3, 1, 2, 2], np.uint8), np.ones(5, np.float32), np.ones(5, np.float32)
    )
    by_tree = with_tree_levels(found, 0.9)
    assert sorted(zip(by_tree.area_px.tolist(), by_tree.level.tolist(), strict=True)) == [
        (2, 2),  # a child of the root
        (2, 3),  # fourth generation
        (3, 3),
        (6, 2),
        (10, 1),
    ]
    assert (by_tree.content_order() == np.arange(5)).all()


def test_theta_decides_levels_by_the_tree():
    # 3 of the second mask's 4 px are in the first
    found = HierarchicalMasks.from_dense(
        rows("########..", ".....####."), np.array([1, 1], np.uint8), *[np.ones(2, np.float32)] * 2
    )
    assert with_tree_levels(found, 0.9).level.tolist() == [1, 1]
    assert with_tree_levels(found, 0.7).level.tolist() == [1, 2]
