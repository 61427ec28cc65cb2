"""Automatic mask generation with a network whose answer is known: discs around the prompts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilsplat.base.levels import Level
from hilsplat.segment.candidates import Candidates, candidates_key, crop_boxes, decode_candidates, floors
from hilsplat.segment.generate import clean_masks, masks_from_candidates
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import SamModel, Thresholds
from hilsplat.settings import MasksSettings
from tests.unit.segment.plain import mend

SETTINGS = MasksSettings(points_per_side=2, points_per_batch=3, stability_min=0.0, min_area_px=1)
IMAGE = np.zeros((32, 32, 3), dtype=np.uint8)


def generate(model: SamModel, settings: MasksSettings = SETTINGS, image: np.ndarray = IMAGE):
    candidates = decode_candidates(image, model, settings)
    return masks_from_candidates(candidates, image.shape[:2], model, settings)


@pytest.fixture(scope="module")
def model(disc_sam) -> SamModel:
    return SamModel.load(disc_sam)


def test_every_prompt_gives_a_disc_at_every_level(model):
    masks = generate(model)
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


def test_predicted_iou_threshold_empties_a_level(model):
    masks = generate(model, SETTINGS.model_copy(update={"predicted_iou_min": 0.75}))
    assert [len(masks.rows_of(level)) for level in Level] == [0, 4, 4]


def test_small_discs_are_less_stable(model):
    candidates = decode_candidates(IMAGE, model, SETTINGS)
    stability = [candidates.stability[candidates.head == head].mean() for head in range(3)]
    assert stability[0] < stability[1] < stability[2]
    # discs of radius r -+ 1: the ratio of areas is about ((r - 1) / (r + 1))^2; radius 6 gives 0.51
    assert stability[1] == pytest.approx(0.51, abs=0.08)


def test_box_suppression_merges_neighbouring_prompts(model):
    many = generate(
        model, SETTINGS.model_copy(update={"points_per_side": 16, "box_nms_iou": 1.0, "nms_iou": 1.0})
    )
    few = generate(
        model, SETTINGS.model_copy(update={"points_per_side": 16, "box_nms_iou": 0.3, "nms_iou": 1.0})
    )
    assert 0 < len(few) < len(many) / 2


@pytest.mark.parametrize("batch", [1, 3, 64])
def test_masks_do_not_depend_on_the_batch(model, batch):
    masks = generate(model, SETTINGS.model_copy(update={"points_per_batch": batch}))
    np.testing.assert_array_equal(masks.runs, generate(model).runs)


def one_row(candidates: Candidates, row: int) -> Candidates:
    low, high = candidates.offsets[row : row + 2]
    arrays = candidates.arrays() | {"logits": candidates.logits[low:high]}
    arrays["offsets"] = np.array([0, high - low])
    for name in ("window_xyxy", "head", "predicted_iou", "stability", "crop"):
        arrays[name] = arrays[name][row : row + 1]
    return Candidates(**arrays)


def test_masks_do_not_depend_on_the_order_of_candidates(model):
    settings = SETTINGS.model_copy(update={"points_per_side": 6, "box_nms_iou": 0.5})
    candidates = decode_candidates(IMAGE, model, settings)
    shuffle = np.random.default_rng(0).permutation(len(candidates.head))
    shuffled = Candidates.concatenate([one_row(candidates, row) for row in shuffle])
    first = masks_from_candidates(candidates, (32, 32), model, settings)
    second = masks_from_candidates(shuffled, (32, 32), model, settings)
    for name, array in first.arrays().items():
        np.testing.assert_array_equal(array, second.arrays()[name], err_msg=name)


def test_masks_have_the_size_of_a_wide_image(model):
    masks = generate(model, image=np.zeros((40, 90, 3), dtype=np.uint8))
    assert masks.size_hw == (40, 90)
    # 90 px become 32: discs grow by 90 / 32
    part = masks.area_px[masks.rows_of(Level.PART)].max()
    assert part <= np.pi * (6 * 90 / 32) ** 2 * 1.1


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
    settings = SETTINGS.model_copy(update={"crop_layers": 1, "nms_inner": 0.0})
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


def cleaned(mask: np.ndarray, min_area_px: int) -> tuple[np.ndarray, np.ndarray]:
    one = np.ones(1, np.float32)
    masks, changed = clean_masks(
        HierarchicalMasks.from_dense(mask[None], np.ones(1, np.uint8), one, one), min_area_px
    )
    return masks.dense(), changed


def test_small_islands_go_and_small_holes_close():
    mask = np.zeros((8, 8), dtype=bool)
    mask[1:6, 1:6] = True
    mask[3, 3] = False
    mask[7, 7] = True
    found, changed = cleaned(mask, min_area_px=4)
    expected = np.zeros((8, 8), dtype=bool)
    expected[1:6, 1:6] = True
    assert changed.tolist() == [True]
    np.testing.assert_array_equal(found[0], expected)


def test_a_mask_that_is_small_as_a_whole_goes():
    mask = np.zeros((8, 8), dtype=bool)
    mask[0, 0] = mask[4, 4] = mask[4, 5] = True
    assert len(cleaned(mask, min_area_px=30)[0]) == 0
    found, changed = cleaned(mask, min_area_px=2)
    assert (found[0].sum(), changed.tolist()) == (2, [True])


@given(hnp.arrays(bool, st.tuples(st.integers(1, 9), st.integers(1, 9))), st.integers(1, 12))
def test_runs_are_cleaned_like_images(mask, min_area_px):
    if not mask.any():
        return
    found, changed = cleaned(mask, min_area_px)
    expected = mend(mask, min_area_px)
    if expected.sum() < min_area_px:
        assert len(found) == 0
    else:
        np.testing.assert_array_equal(found[0], expected)
        assert changed.tolist() == [(expected != mask).any()]


def test_cache_key_covers_what_the_network_sees_and_no_more(model):
    key = candidates_key("image", model, SETTINGS)
    for change in ({"predicted_iou_min": 0.5}, {"nms_iou": 0.5}, {"min_area_px": 50}, {"box_nms_iou": 0.1}):
        assert candidates_key("image", model, SETTINGS.model_copy(update=change)) == key
    for change in (
        {"points_per_side": 3},
        {"crop_layers": 1},
        {"stability_offset": 0.5},
        {"predicted_iou_min": 0.05},
    ):
        assert candidates_key("image", model, SETTINGS.model_copy(update=change)) != key
    assert candidates_key("another", model, SETTINGS) != key


def test_floors_follow_thresholds_below_the_loose_one():
    assert floors(Thresholds(0.35, 0.02, 0.0, 64)) == (0.1, 0.02)
