"""Automatic mask generation with a network whose answer is known: discs around the prompts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilsplat.base.levels import Level
from hilsplat.models.folder import open_model_folder
from hilsplat.segment.coverage import coverage_tree
from hilsplat.segment.generate import (
    Candidates,
    candidates_key,
    clean_masks,
    crop_boxes,
    decode_candidates,
    floors,
    masks_from_candidates,
)
from hilsplat.segment.sam import Encoded, SamModel, Thresholds
from hilsplat.settings import MasksSettings
from tests.unit.segment.handmade import assert_equal_masks, generate, pack
from tests.unit.segment.plain import mend

SETTINGS = MasksSettings(points_per_side=2, points_per_batch=3, stability_min=0.0, min_area_px=1)
IMAGE = np.zeros((32, 32, 3), dtype=np.uint8)


def changed(**settings: object) -> MasksSettings:
    return SETTINGS.model_copy(update=settings)


@pytest.fixture(scope="module")
def model(disc_sam) -> SamModel:
    return SamModel.load(disc_sam)


def test_every_prompt_gives_a_disc_at_every_level(model):
    masks = generate(model, SETTINGS, IMAGE)
    assert [len(masks.rows_of(level)) for level in Level] == [4, 4, 4]
    for level, radius, score in ((Level.WHOLE, 10, 0.7), (Level.PART, 6, 0.8), (Level.SUBPART, 3, 0.9)):
        rows = masks.rows_of(level)
        np.testing.assert_allclose(masks.predicted_iou[rows], score, rtol=1e-6)
        centres = set()
        for mask, area in zip(masks.dense(rows), masks.area_px[rows], strict=True):
            ys, xs = np.nonzero(mask)
            centres.add((round((xs.min() + xs.max() + 1) / 2 / 8), round((ys.min() + ys.max() + 1) / 2 / 8)))
            if level != Level.WHOLE:  # the largest discs leave the image
                assert area == pytest.approx(np.pi * radius**2, rel=0.2)
        if level != Level.WHOLE:
            assert centres == {(1, 1), (3, 1), (1, 3), (3, 3)}  # prompts at 8 and 24 px


def test_small_discs_are_less_stable(model):
    candidates = decode_candidates(IMAGE, model, SETTINGS)
    stability = [candidates.stability[candidates.head == head].mean() for head in range(3)]
    assert stability[0] < stability[1] < stability[2]
    # discs of radius r -+ 1: the ratio of areas is about ((r - 1) / (r + 1))^2; radius 6 gives 0.51
    assert stability[1] == pytest.approx(0.51, abs=0.08)


def test_box_suppression_merges_neighbouring_prompts(model):
    many, few = (
        generate(model, changed(points_per_side=16, nms_iou=1.0, box_nms_iou=iou_max), IMAGE)
        for iou_max in (1.0, 0.3)
    )
    assert 0 < len(few) < len(many) / 2


@pytest.mark.parametrize("batch", [1, 3, 64])
def test_masks_do_not_depend_on_the_batch(model, batch):
    masks = generate(model, changed(points_per_batch=batch), IMAGE)
    np.testing.assert_array_equal(masks.runs, generate(model, SETTINGS, IMAGE).runs)


def one_row(candidates: Candidates, row: int) -> Candidates:
    low, high = candidates.offsets[row : row + 2]
    arrays = vars(candidates) | {"logits": candidates.logits[low:high]}
    arrays["offsets"] = np.array([0, high - low])
    for name in ("window_xyxy", "head", "predicted_iou", "stability", "crop"):
        arrays[name] = arrays[name][row : row + 1]
    return Candidates(**arrays)


def test_masks_do_not_depend_on_the_order_of_candidates(model):
    settings = changed(points_per_side=6, box_nms_iou=0.5)
    candidates = decode_candidates(IMAGE, model, settings)
    shuffle = np.random.default_rng(0).permutation(len(candidates.head))
    shuffled = Candidates.concatenate([one_row(candidates, row) for row in shuffle])
    first = masks_from_candidates(candidates, (32, 32), model, settings)
    assert_equal_masks(masks_from_candidates(shuffled, (32, 32), model, settings), first)


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


def test_crops_find_finer_masks_and_drop_those_they_cut(model):
    image = np.zeros((128, 128, 3), dtype=np.uint8)
    settings = changed(crop_layers=1, nms_inner=0.0)
    candidates = decode_candidates(image, model, settings)
    assert set(candidates.crop.tolist()) == {0, 1, 2, 3, 4}
    masks = masks_from_candidates(candidates, (128, 128), model, settings)
    plain = generate(model, SETTINGS, image)
    # whole image: 12 px of radius 3 at 128 px; crops of 86 px: 8 px
    smallest = masks.area_px[masks.rows_of(Level.SUBPART)].min()
    assert smallest < 0.6 * plain.area_px[plain.rows_of(Level.SUBPART)].min()
    for box in masks.box_xyxy:
        for crop in crop_boxes((128, 128), 1)[0][1:]:
            cut = np.abs(box - crop) <= 0
            assert not (cut & ~(np.abs(box - [0, 0, 128, 128]) <= 20)).any()


@given(hnp.arrays(bool, st.tuples(st.integers(1, 9), st.integers(1, 9))), st.integers(1, 12))
def test_small_islands_go_small_holes_close_and_small_masks_go(mask, min_area_px):
    if not mask.any():
        return
    found, changed = clean_masks(pack(mask[None]), min_area_px)
    expected = mend(mask, min_area_px)
    if expected.sum() < min_area_px:
        assert len(found) == 0
    else:
        np.testing.assert_array_equal(found.dense()[0], expected)
        assert changed.tolist() == [(expected != mask).any()]


def test_cache_key_covers_what_the_network_sees_and_no_more(model):
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
    assert len(masks) > 0
    parent, _ = coverage_tree(masks, theta=0.9)
    assert len(parent) == len(masks)


def test_a_view_without_masks_goes_through(model):
    none = generate(model, changed(min_area_px=5000), IMAGE)
    assert (len(none), none.size_hw) == (0, (32, 32))
    parent, depth = coverage_tree(none, theta=0.9)
    assert parent.shape == depth.shape == (0,)


def test_a_photograph_of_40_megapixels_needs_no_picture_per_mask(model):
    masks = generate(model, changed(min_area_px=100), np.zeros((5480, 7300, 3), np.uint8))
    assert masks.size_hw == (5480, 7300)
    # a disc of radius 6 in a frame of 32 px whose longer side is 7300 px
    part = masks.area_px[masks.rows_of(Level.PART)].max()
    assert part == pytest.approx(np.pi * (6 * 7300 / 32) ** 2, rel=0.2)
    assert masks.runs.nbytes < 2**22
    coverage_tree(masks, theta=0.9)


def test_of_two_masks_above_one_the_surer_stays(disc_sam):
    """The network is surer of the smaller disc: 1.06 and 1.02. Cut to 1, the larger would win the tie."""

    class Sure(SamModel):
        def decode(self, encoded: Encoded, points_xy: np.ndarray):
            y, x = np.mgrid[:16, :16]
            is_first = np.arange(len(points_xy)) == 0
            radii = np.where(is_first, 5.2, 4.8)
            discs = (radii[:, None, None] - np.hypot(x - 7.5, y - 7.5)[None]).astype(np.float32)
            scores = np.where(is_first, 1.02, 1.06).astype(np.float32)
            return np.repeat(scores[:, None], 3, axis=1), np.repeat(discs[:, None], 3, axis=1)

    masks = generate(Sure(open_model_folder(disc_sam)), changed(points_per_batch="auto"), IMAGE)
    assert masks.predicted_iou.tolist() == [np.float32(1.06)] * 3


def test_floors_follow_thresholds_below_the_loose_one():
    assert floors(Thresholds(0.35, 0.02, 0.0, 64)) == (0.1, 0.02)
