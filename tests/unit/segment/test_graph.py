"""The graph segmenter: nested scales, and scores that mean something."""

import numpy as np
import pytest

from hilsplat.base.levels import NONE, Level
from hilsplat.segment.coverage import coverage_tree
from hilsplat.segment.graph import cut, merge_regions, segment_graph

SCALES = (0.12, 0.04, 0.015)


def mosaic() -> np.ndarray:
    """A grey ground, a blue square in it, and in that a slightly lighter square."""
    image = np.full((160, 160, 3), 120, dtype=np.uint8)
    image[30:110, 30:110] = (40, 60, 200)
    image[60:72, 60:72] = (60, 90, 215)
    return image


def test_clear_regions_are_found_to_the_pixel_or_two():
    masks = segment_graph(mosaic(), SCALES, min_area_px=16)
    wholes = masks.dense(masks.rows_of(Level.WHOLE))
    assert len(wholes) == 2
    square = np.zeros((160, 160), dtype=bool)
    square[30:110, 30:110] = True
    iou = max((mask & square).sum() / (mask | square).sum() for mask in wholes)
    assert iou > 0.95


def test_fine_detail_appears_at_the_finer_levels_only():
    masks = segment_graph(mosaic(), SCALES, min_area_px=16)
    detail = np.zeros((160, 160), dtype=bool)
    detail[60:72, 60:72] = True

    def best(level: Level) -> float:
        return max(
            (mask & detail).sum() / (mask | detail).sum() for mask in masks.dense(masks.rows_of(level))
        )

    assert best(Level.WHOLE) < 0.1
    assert best(Level.SUBPART) > 0.7


def test_every_level_covers_the_image_and_levels_nest():
    generator = np.random.default_rng(0)
    blocks = generator.integers(0, 255, (8, 8, 3), dtype=np.uint8)
    image = np.repeat(np.repeat(blocks, 20, axis=0), 20, axis=1)
    masks = segment_graph(image, SCALES, min_area_px=1)
    dense = masks.dense()
    for level in Level:
        assert (dense[masks.rows_of(level)].sum(axis=0) == 1).all()
    for coarse, fine in ((Level.WHOLE, Level.PART), (Level.PART, Level.SUBPART)):
        for child in dense[masks.rows_of(fine)]:
            covers = [(child & parent).sum() / child.sum() for parent in dense[masks.rows_of(coarse)]]
            assert max(covers) == 1.0


def test_parents_of_the_detail_is_the_square():
    masks = segment_graph(mosaic(), SCALES, min_area_px=16)
    parent, _ = coverage_tree(masks, theta=0.9)
    smallest = int(masks.area_px.argmin())
    assert parent[smallest] != NONE
    assert masks.area_px[parent[smallest]] == pytest.approx(80 * 80, rel=0.05)


def test_scores_are_shares_and_a_clear_region_has_the_better_one():
    masks = segment_graph(mosaic(), SCALES, min_area_px=16)
    for score in (masks.predicted_iou, masks.stability):
        assert ((score >= 0) & (score <= 1)).all()
    detail = np.zeros((160, 160), dtype=bool)
    detail[60:72, 60:72] = True
    faint = int(
        ((masks.dense() & detail).sum(axis=(1, 2)) / (masks.dense() | detail).sum(axis=(1, 2))).argmax()
    )
    assert masks.predicted_iou[masks.rows_of(Level.WHOLE)].min() > masks.predicted_iou[faint] > 0


def test_one_colour_is_one_region():
    masks = segment_graph(np.full((40, 60, 3), 77, dtype=np.uint8), SCALES, min_area_px=16)
    assert [len(masks.rows_of(level)) for level in Level] == [1, 1, 1]
    assert (masks.area_px == 40 * 60).all()


def test_the_cheapest_pair_merges_first():
    labels = np.repeat(np.array([[0, 1, 2]], dtype=np.int32), 10, axis=1).repeat(10, axis=0)
    lab = np.zeros((10, 30, 3), dtype=np.float32)
    lab[:, 10:20], lab[:, 20:] = 5, 30  # 0 and 1 are alike
    merges = merge_regions(labels, lab)
    assert [pair[1:] for pair in merges] == [(0, 1), (2, 3)]
    between = (merges[0][0] + merges[1][0]) / 2
    regions, dies = cut(labels, merges, between)
    assert regions[0, 0] == regions[0, 10] != regions[0, 20]
    np.testing.assert_allclose(dies, merges[1][0])
