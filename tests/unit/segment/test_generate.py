"""Automatic mask generation, with a network that returns discs around the prompts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilsplat.base.levels import Level
from hilsplat.segment.coverage import coverage_tree
from hilsplat.segment.generate import (
    candidates_key,
    clean_masks,
    crop_boxes,
    decode_candidates,
    distinct_prompts,
    keep_candidates,
    masks_from_candidates,
)
from hilsplat.segment.sam import Encoded, Frame, Prompts, SamModel, enlarged, point_grid
from hilsplat.segment.thresholds import Thresholds
from hilsplat.settings import MasksSettings
from tests.unit.segment import official
from tests.unit.segment.handmade import assert_equal_masks, generate, pack, quantise, smooth_logits

SETTINGS = MasksSettings(points_per_side=2, points_per_batch=3, stability_min=0.0, min_area_px=1)
IMAGE = np.zeros((32, 32, 3), dtype=np.uint8)
EVERYTHING = MasksSettings(
    predicted_iou_min=0, stability_min=0, nms_score=0, min_area_px=1, box_nms_iou=1, nms_iou=1, nms_inner=0
)
NOTHING_DROPPED = Thresholds(predicted_iou_min=0.0, stability_min=0.0, nms_score=0.0, points_per_batch=64)


def changed(**settings: object) -> MasksSettings:
    return SETTINGS.model_copy(update=settings)


@pytest.fixture(scope="module")
def model(disc_sam) -> SamModel:
    return SamModel.load(disc_sam)


@pytest.mark.parametrize("batch", [1, 3, 64])
def test_every_prompt_produces_a_disc_at_every_level_whatever_the_batch(model, batch):
    masks = generate(model, changed(points_per_batch=batch), IMAGE)
    for level, radius, score in ((Level.WHOLE, 10, 0.7), (Level.PART, 6, 0.8), (Level.SUBPART, 3, 0.9)):
        rows = masks.rows_of(level)
        assert len(rows) == 4
        np.testing.assert_allclose(masks.predicted_iou[rows], score, rtol=1e-6)
        if level != Level.WHOLE:  # the largest discs leave the image
            np.testing.assert_allclose(masks.area_px[rows], np.pi * radius**2, rtol=0.2)
            boxes = masks.box_xyxy[rows]
            centres = np.rint((boxes[:, :2] + boxes[:, 2:]) / 16).tolist()
            assert sorted(centres) == [[1, 1], [1, 3], [3, 1], [3, 3]]  # prompts at 8 and 24 px


def test_masks_do_not_depend_on_the_order_of_prompts(model):
    settings = changed(points_per_side=6, box_nms_iou=0.5)
    points = np.random.default_rng(0).permutation(point_grid(6) * 32)
    candidates = decode_candidates(IMAGE, model, settings, points)
    expected = generate(model, settings, IMAGE)
    assert_equal_masks(masks_from_candidates(candidates, (32, 32), model, settings), expected)


def test_crops_by_hand():
    boxes, layers = crop_boxes((100, 200), 1)
    # overlap int(512 / 1500 * 100) = 34; crops (200 + 34) / 2 = 117 wide, (100 + 34) / 2 = 67 high
    assert boxes.tolist() == [
        [0, 0, 200, 100],
        [0, 0, 117, 67],
        [0, 33, 117, 100],
        [83, 0, 200, 67],
        [83, 33, 200, 100],
    ]
    assert layers.tolist() == [0, 1, 1, 1, 1]


@given(hnp.arrays(bool, st.tuples(st.integers(1, 9), st.integers(1, 9))), st.integers(1, 12))
def test_small_islands_holes_and_masks_are_removed(mask, min_area_px):
    if not mask.any():
        return
    found, changed = clean_masks(pack(mask[None]), min_area_px)
    expected, _ = official.without_small_regions(mask, min_area_px, "holes")
    expected, _ = official.without_small_regions(expected, min_area_px, "islands")
    if expected.sum() < min_area_px:
        assert len(found) == 0
    else:
        np.testing.assert_array_equal(found.dense()[0], expected)
        assert changed.tolist() == [(expected != mask).any()]


def test_cache_key_depends_on_the_inputs_of_the_network_only(model):
    key = candidates_key("image", model, SETTINGS)
    for change in ({"predicted_iou_min": 0.5}, {"nms_iou": 0.5}, {"min_area_px": 50}, {"box_nms_iou": 0.1}):
        assert candidates_key("image", model, changed(**change)) == key
    for change in ({"points_per_side": 3}, {"crop_layers": 1}, {"stability_offset": 0.5}):
        assert candidates_key("image", model, changed(**change)) != key
    assert candidates_key("image", model, changed(predicted_iou_min=0.05)) != key
    assert candidates_key("another", model, SETTINGS) != key


@pytest.mark.parametrize("size_hw", [(1, 1), (50, 1), (1, 700), (3, 5)])
@pytest.mark.parametrize("crop_layers", [0, 1])
def test_an_image_of_one_pixel_width_has_masks_of_its_size(model, size_hw, crop_layers):
    image = np.full((*size_hw, 3), 90, np.uint8)
    masks = generate(model, changed(points_per_side=3, crop_layers=crop_layers), image)
    assert masks.size_hw == size_hw
    assert len(masks) == len(coverage_tree(masks, theta=0.9)[0]) > 0


def test_a_view_may_have_no_masks(model):
    none = generate(model, changed(min_area_px=5000), IMAGE)
    assert (len(none), none.size_hw) == (0, (32, 32))
    assert [len(each) for each in coverage_tree(none, theta=0.9)] == [0, 0]


@pytest.mark.parametrize(
    "original_hw", [(32, 24), (100, 128), (256, 256), (480, 640), (728, 986), (300, 3), (1, 200), (64, 1)]
)
def test_masks_from_windows_equal_enlarged_masks(original_hw, disc_sam):
    model = SamModel.load(disc_sam)
    model.longest_edge, model.padded_hw = 256, (256, 256)
    frame = model.frame(original_hw)
    logits = smooth_logits(30, 64, seed=sum(original_hw))
    logits[0], logits[1] = -3, 3  # without an edge: an empty and a full mask
    scores = np.linspace(0.5, 1, 30, dtype=np.float32).reshape(10, 3)
    heads = logits.reshape(10, 3, 64, 64)
    kept = keep_candidates(scores, heads, frame, 0, EVERYTHING, NOTHING_DROPPED)
    masks = masks_from_candidates(kept, original_hw, model, EVERYTHING)
    expected = [mask for mask in enlarged(quantise(logits).astype(np.float32), frame) if mask.any()]
    found = list(masks.dense())
    assert len(found) == len(expected) > 5
    for mask in found:  # rounding may decide on the border itself
        assert min((mask != other).mean() for other in expected) < 2e-4


class Previewed(SamModel):
    """A SAM whose previews are given scores and discs (centre x, radius) in 16 x 16 px."""

    def __init__(self, scores: list[list[float]], discs: list[list[tuple[float, float]]]):
        self.scores, self.discs = np.array(scores, np.float32), np.array(discs, np.float32)

    def preview(self, encoded: Encoded, points_xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, Prompts]:
        rows = points_xy[:, 0].astype(int)
        y, x = np.mgrid[:16, :16].astype(np.float32)
        centre, radius = (self.discs[rows, :, number, None, None] for number in (0, 1))
        return self.scores[rows], 4 * (radius - np.hypot(x - centre, y - 8)), {"points": points_xy}


def prompts_of(model: Previewed) -> list[int]:
    points = np.stack([np.arange(len(model.scores))] * 2, axis=1).astype(np.float64)
    encoded = Encoded({}, Frame((64, 64), (64, 64), (64, 64)))
    kept = distinct_prompts(encoded, {"points": points}, model, MasksSettings(), batch=2)
    return kept["points"][:, 0].astype(int).tolist()


def test_prompts_with_a_mask_that_repeats_no_better_one_are_kept():
    small, middle, large = (8, 2.2), (8, 4.2), (8, 6.2)
    scores = [[0.5, 0.5, 0.5], [0.6, 0.5, 0.5], [0.5, 0.5, 0.4], [0.4, 0.4, 0.05]]
    discs = [[small, middle, large]] * 2 + [[small, (4, 3.2), large], [small, middle, (9, 6.2)]]
    # 0 is as good as 1 at two heads, and the earlier; 1 is better at the first; 2 shows another part; the
    # other whole of 3 is below the floor of 0.1
    assert prompts_of(Previewed(scores, discs)) == [0, 1, 2]


def test_one_prompt_is_kept_if_the_preview_is_empty():
    assert prompts_of(Previewed([[0.05] * 3] * 3, [[(8, 3)] * 3] * 3)) == [0]
