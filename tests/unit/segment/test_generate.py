"""Automatic mask generation with a network whose masks are known: discs around the prompts."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from benchmarks.canned_sam import CannedSam, NetworkClock
from hilsplat.base.levels import Level
from hilsplat.models.folder import open_model_folder
from hilsplat.segment.coverage import coverage_tree
from hilsplat.segment.generate import (
    Candidates,
    candidates_key,
    clean_masks,
    crop_boxes,
    decode_candidates,
    masks_from_candidates,
)
from hilsplat.segment.sam import Encoded, SamModel
from hilsplat.settings import MasksSettings
from tests.unit.segment.handmade import assert_equal_masks, generate, pack
from tests.unit.segment.plain import mend

SETTINGS = MasksSettings(points_per_side=2, points_per_batch=3, stability_min=0.0, min_area_px=1)
IMAGE = np.zeros((32, 32, 3), dtype=np.uint8)
CLEAR = Path("/proc/self/clear_refs")


def changed(**settings: object) -> MasksSettings:
    return SETTINGS.model_copy(update=settings)


@pytest.fixture(scope="module")
def model(disc_sam) -> SamModel:
    return SamModel.load(disc_sam)


def test_every_prompt_produces_a_disc_at_every_level(model):
    masks = generate(model, SETTINGS, IMAGE)
    for level, radius, score in ((Level.WHOLE, 10, 0.7), (Level.PART, 6, 0.8), (Level.SUBPART, 3, 0.9)):
        rows = masks.rows_of(level)
        assert len(rows) == 4
        np.testing.assert_allclose(masks.predicted_iou[rows], score, rtol=1e-6)
        if level != Level.WHOLE:  # the largest discs leave the image
            np.testing.assert_allclose(masks.area_px[rows], np.pi * radius**2, rtol=0.2)
            boxes = masks.box_xyxy[rows]
            centres = np.rint((boxes[:, :2] + boxes[:, 2:]) / 16).tolist()
            assert sorted(centres) == [[1, 1], [1, 3], [3, 1], [3, 3]]  # prompts at 8 and 24 px


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


def test_crops_find_finer_masks_and_truncated_ones_are_dropped(model):
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
def test_small_islands_holes_and_masks_are_removed(mask, min_area_px):
    if not mask.any():
        return
    found, changed = clean_masks(pack(mask[None]), min_area_px)
    expected = mend(mask, min_area_px)
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
    assert len(masks) > 0
    parent, _ = coverage_tree(masks, theta=0.9)
    assert len(parent) == len(masks)


def test_a_view_may_have_no_masks(model):
    none = generate(model, changed(min_area_px=5000), IMAGE)
    assert (len(none), none.size_hw) == (0, (32, 32))
    assert [len(each) for each in coverage_tree(none, theta=0.9)] == [0, 0]


def test_of_two_predicted_ious_above_1_the_higher_wins(disc_sam):
    """The smaller disc has the higher predicted IoU, 1.06 and 1.02. Clipped to 1, the larger would win."""

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


def status_mib(name: str) -> float:
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name)]
    return int(line.split()[1]) / 1024


@pytest.mark.skipif(not CLEAR.exists(), reason="only Linux can reset the peak of memory (/proc)")
def test_three_thousand_candidates_stay_below_the_bound():
    model = CannedSam(NetworkClock())
    settings = MasksSettings(
        points_per_batch=64, predicted_iou_min=0.7, stability_min=0.5, nms_score=0, min_area_px=100
    )
    image = np.random.default_rng(0).integers(0, 255, (728, 986, 3), dtype=np.uint8)
    CLEAR.write_text("5")
    before = status_mib("VmRSS")
    candidates = decode_candidates(image, model, settings)
    masks = masks_from_candidates(candidates, (728, 986), model, settings)
    coverage_tree(masks, theta=0.9)
    assert len(candidates) >= 3000
    assert len(masks) > 100
    # the bound is 1.5 GiB; one call of 64 prompts alone holds 50 MiB of logits, here twice
    assert status_mib("VmHWM") - before < 400
