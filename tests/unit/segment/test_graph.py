"""The graph segmenter: nested scales and plausible scores."""

import numpy as np
import pytest

from hilsplat.base.levels import Level
from hilsplat.segment.graph import segment_graph
from hilsplat.segment.masks import HierarchicalMasks

SCALES = (0.12, 0.04, 0.015)


def mosaic() -> np.ndarray:
    """A grey ground, a blue square in it, and in that a slightly lighter square."""
    image = np.full((160, 160, 3), 120, dtype=np.uint8)
    image[30:110, 30:110] = (40, 60, 200)
    image[60:72, 60:72] = (60, 90, 215)
    return image


def ious(masks: HierarchicalMasks, first: int, last: int) -> np.ndarray:
    """IoU of each mask with a square of the mosaic."""
    square = np.zeros((160, 160), dtype=bool)
    square[first:last, first:last] = True
    dense = masks.dense()
    return (dense & square).sum(axis=(1, 2)) / (dense | square).sum(axis=(1, 2))


def test_clear_regions_are_wholes_and_fine_detail_appears_at_finer_levels_only():
    masks = segment_graph(mosaic(), SCALES, min_area_px=16)
    wholes, subparts = masks.rows_of(Level.WHOLE), masks.rows_of(Level.SUBPART)
    assert len(wholes) == 2
    assert ious(masks, 30, 110)[wholes].max() > 0.95
    detail = ious(masks, 60, 72)
    assert detail[wholes].max() < 0.1 and detail[subparts].max() > 0.7
    for score in (masks.predicted_iou, masks.stability):
        assert ((score >= 0) & (score <= 1)).all()
        assert score[wholes].min() > score[detail.argmax()] > 0  # a clear region has the better score


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


@pytest.mark.parametrize("size_hw", [(1, 1), (50, 1), (1, 700), (3, 5), (40, 60)])
def test_an_image_of_one_colour_is_one_region(size_hw):
    masks = segment_graph(np.full((*size_hw, 3), 90, np.uint8), SCALES, min_area_px=1)
    assert [len(masks.rows_of(level)) for level in Level] == [1, 1, 1]
    assert (masks.area_px == size_hw[0] * size_hw[1]).all()


def test_large_images_are_segmented_at_a_smaller_size():
    image = np.full((1370, 1825, 3), 120, np.uint8)
    image[250:750, 250:1000] = (40, 60, 200)
    masks = segment_graph(image, SCALES, min_area_px=100)
    wholes = masks.area_px[masks.rows_of(Level.WHOLE)]
    assert sorted(wholes) == pytest.approx([500 * 750, 1370 * 1825 - 500 * 750], rel=0.02)
