"""Views of unusual size or content pass through both segmenters."""

import numpy as np
import pytest

from hilsplat.base.levels import Level
from hilsplat.segment.candidates import decode_candidates
from hilsplat.segment.coverage import coverage_tree
from hilsplat.segment.generate import masks_from_candidates
from hilsplat.segment.graph import segment_graph
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import SamModel
from hilsplat.settings import MasksSettings

SCALES = MasksSettings().graph_scales
SETTINGS = MasksSettings(points_per_side=3, stability_min=0, min_area_px=1)


@pytest.fixture(scope="module")
def model(disc_sam) -> SamModel:
    return SamModel.load(disc_sam)


def by_sam(image: np.ndarray, model: SamModel, settings: MasksSettings) -> HierarchicalMasks:
    return masks_from_candidates(decode_candidates(image, model, settings), image.shape[:2], model, settings)


@pytest.mark.parametrize("size_hw", [(1, 1), (50, 1), (1, 700), (3, 5)])
@pytest.mark.parametrize("crop_layers", [0, 1])
def test_an_image_of_one_pixel_width_has_masks_of_its_size(model, size_hw, crop_layers):
    image = np.full((*size_hw, 3), 90, np.uint8)
    masks = by_sam(image, model, SETTINGS.model_copy(update={"crop_layers": crop_layers}))
    assert masks.size_hw == size_hw
    assert len(masks) > 0
    parent, _ = coverage_tree(masks, theta=0.9)
    assert len(parent) == len(masks)


@pytest.mark.parametrize("size_hw", [(1, 1), (50, 1), (1, 700), (3, 5)])
def test_the_graph_segmenter_takes_thin_images(size_hw):
    masks = segment_graph(np.full((*size_hw, 3), 90, np.uint8), SCALES, min_area_px=1)
    assert [len(masks.rows_of(level)) for level in Level] == [1, 1, 1]
    assert (masks.area_px == size_hw[0] * size_hw[1]).all()


def test_an_image_of_one_colour_has_the_masks_of_the_network(model):
    flat = by_sam(np.full((32, 32, 3), 200, np.uint8), model, SETTINGS)
    assert [len(flat.rows_of(level)) for level in Level] == [9, 9, 9]


def test_a_view_without_masks_goes_through(model):
    none = by_sam(np.zeros((32, 32, 3), np.uint8), model, SETTINGS.model_copy(update={"min_area_px": 5000}))
    assert len(none) == 0
    assert none.size_hw == (32, 32)
    parent, depth = coverage_tree(none, theta=0.9)
    assert len(parent) == len(depth) == 0


def test_a_photograph_of_40_megapixels_needs_no_picture_per_mask(model):
    image = np.zeros((5480, 7300, 3), np.uint8)
    masks = by_sam(image, model, SETTINGS.model_copy(update={"min_area_px": 100}))
    assert masks.size_hw == (5480, 7300)
    # a disc of radius 6 in a frame of 32 px whose longer side is 7300 px
    part = masks.area_px[masks.rows_of(Level.PART)].max()
    assert part == pytest.approx(np.pi * (6 * 7300 / 32) ** 2, rel=0.2)
    assert masks.runs.nbytes < 2**22
    coverage_tree(masks, theta=0.9)


def test_the_graph_segmenter_takes_40_megapixels():
    image = np.full((5480, 7300, 3), 120, np.uint8)
    image[1000:3000, 1000:4000] = (40, 60, 200)
    masks = segment_graph(image, SCALES, min_area_px=100)
    wholes = masks.area_px[masks.rows_of(Level.WHOLE)]
    assert sorted(wholes / 1e6) == pytest.approx([6, 34.004], rel=0.02)
