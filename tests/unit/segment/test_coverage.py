"""The coverage tree of a view (paper, Sec. III-B)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilsplat.base.levels import NONE
from hilsplat.segment.coverage import coverage_parents, coverage_tree, levelled
from hilsplat.settings import MasksSettings
from tests.unit.segment.handmade import pack

shapes = st.tuples(st.integers(1, 8), st.just(3), st.just(4))
nonempty_masks = hnp.arrays(bool, shapes).filter(lambda masks: masks.any(axis=(1, 2)).all())


def rows(*texts: str) -> np.ndarray:
    """Masks of one image row: `#` inside, `.` outside."""
    return np.array([[[letter == "#" for letter in text]] for text in texts])


def of_tree(theta: float) -> MasksSettings:
    return MasksSettings(levels="tree", theta=theta)


def parents_of(masks: np.ndarray, theta: float, level: list[int]) -> list[int]:
    return coverage_parents(pack(masks).overlaps_px(), np.array(level, np.uint8), theta).tolist()


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


@pytest.mark.parametrize(
    ("texts", "level", "expected"),
    [
        # the smallest cover is the parent
        (("##########", "#####.....", "##........"), [1, 2, 3], [NONE, 0, 1]),
        # of two equally small covers the lower row wins
        (("####", "####", "#..."), [1, 1, 2], [NONE, NONE, 0]),
        # a parent of the same level is refused
        (("##########", "#####.....", "##........"), [1, 3, 3], [NONE, 0, 0]),
        # the parent of a subpart may be a whole
        (("##...", "#####"), [3, 1], [1, NONE]),
        # the smallest cover wins even if it is the coarser one
        (("##########", "######....", "##........"), [2, 1, 3], [NONE, NONE, 1]),
    ],
)
def test_parents_by_hand(texts, level, expected):
    assert parents_of(rows(*texts), 0.9, level) == expected


@pytest.mark.parametrize(
    ("theta", "expected"),
    [
        (0.9, [NONE, NONE]),  # 9 of the last mask's 10 px are in the first: 0.9 > 0.9 is false
        (0.85, [NONE, 0]),  # 9 of the first mask's 13 px are in the last: 0.69 < 0.85
        (0.65, [NONE, NONE]),  # 0.69 > 0.65: too much of the first mask is in the last
        (9 / 13, [NONE, NONE]),  # exactly theta of the first mask is too much
    ],
)
def test_both_shares_are_compared_with_theta(theta, expected):
    assert parents_of(rows(".#############", "##########...."), theta, [1, 2]) == expected


@given(nonempty_masks, st.floats(0.51, 0.99), st.data())
def test_the_tree_equals_a_loop_over_pairs(masks, theta, data):
    level = data.draw(hnp.arrays(np.uint8, len(masks), elements=st.integers(1, 3)))
    parent, depth = coverage_tree(pack(masks, level), theta)
    assert parent.tolist() == parents_by_loop(masks, theta, level)
    children = np.flatnonzero(parent != NONE)
    assert (depth[children] == depth[parent[children]] + 1).all()
    assert (depth[parent == NONE] == 1).all()


def test_levels_by_the_tree_are_depths_for_masks_of_any_head_and_depend_on_theta():
    masks = rows("##########", "######....", "###.......", "##........", ".......##.")
    by_tree = levelled(pack(masks, [3, 3, 1, 2, 2]), of_tree(0.9))
    assert sorted(zip(by_tree.area_px.tolist(), by_tree.level.tolist(), strict=True)) == [
        (2, 2),  # a child of the root
        (2, 3),  # fourth generation
        (3, 3),
        (6, 2),
        (10, 1),
    ]
    overlapping = pack(rows("########..", ".....####."))  # 3 of the second mask's 4 px are in the first
    assert levelled(overlapping, of_tree(0.9)).level.tolist() == [1, 1]
    assert levelled(overlapping, of_tree(0.7)).level.tolist() == [1, 2]
