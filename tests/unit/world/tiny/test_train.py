"""Training learns, repeats itself, and measures what it says."""

import numpy as np
import pytest
import torch

from hilsplat.world.tiny.clip import contrastive_loss
from hilsplat.world.tiny.data import RoughMask, collect_crops
from hilsplat.world.tiny.steps import learning_rate
from hilsplat.world.tiny.train_clip import crop_weights, train_clip
from hilsplat.world.tiny.train_sam import (
    CropStage,
    segment_everything,
    segmentation_loss,
    stage_of_step,
    target_masks,
    train_sam,
)
from tests.unit.world.tiny.drawn import drawn_views

SMALL = (CropStage(1.0, 64, 4, 8),)


@pytest.fixture(scope="module")
def trained():
    views, unseen = drawn_views(6, 64), drawn_views(2, 64, seed=9)
    return train_sam(views, unseen, steps=24, seed=0, stages=SMALL, peak=4e-3, measure_every=8)


def test_the_segmenter_learns_and_segments(trained):
    encoder, decoder, curve = trained
    assert curve.rows[-1]["mask_loss"] < 0.7 * curve.rows[0]["mask_loss"]
    assert curve.rows[-1]["semantic_loss"] < curve.rows[0]["semantic_loss"]
    masks = segment_everything(encoder, decoder, drawn_views(1, 64, seed=9).images[0], 8, 0.0, 0.0)
    assert {mask.level for mask in masks} == {1, 2, 3}
    assert all(mask.mask.any() for mask in masks)


def test_training_repeats_itself():
    views = drawn_views(2, 64)
    rows = [train_sam(views, views, steps=2, seed=3, stages=SMALL, measure_every=1)[2].rows for _ in range(2)]
    for first, second in zip(*rows, strict=True):
        assert first["mask_loss"] == second["mask_loss"]


def test_clip_learns():
    crops = collect_crops(drawn_views(6, 64), [], seed=0)
    unseen = collect_crops(drawn_views(2, 64, seed=9), [], seed=0, jitter=False)
    _, _, _, curve = train_clip(crops, unseen, steps=30, seed=0, batch=24, measure_every=10)
    assert curve.rows[-1]["loss"] < curve.rows[0]["loss"]
    assert curve.rows[-1]["exact_whole"] > 0.5


def test_the_target_of_a_mask_is_the_share_of_each_block():
    targets = torch.full((1, 3, 2, 4), -1)
    targets[0, :, 0, 0] = 7
    targets[0, :, :, 2:] = 7
    found = target_masks(targets, torch.full((1, 1, 3), 7))
    # the left block has one of four pixels, the right block all of them
    assert found.shape == (1, 1, 3, 1, 2)
    assert found[0, 0, 0].tolist() == [[0.25, 1.0]]


def test_segmentation_loss_is_small_for_the_right_mask_and_ignores_unknown_heads():
    truth = torch.zeros(1, 1, 3, 8, 8)
    truth[..., 2:6, 2:6] = 1
    right, wrong = (truth * 2 - 1) * 20, (1 - truth * 2) * 20
    known = torch.tensor([[[1.0, 1.0, 1.0]]])
    masks, quality = segmentation_loss(torch.ones(1, 1, 3), right, truth, known)
    assert masks.item() == pytest.approx(0.0, abs=1e-3)
    assert quality.item() == 0.0
    one_wrong = torch.cat([right[:, :, :2], wrong[:, :, 2:]], dim=2)
    masks, quality = segmentation_loss(
        torch.tensor([[[1.0, 1.0, 0.0]]]), one_wrong, truth, torch.tensor([[[1.0, 1.0, 0.0]]])
    )
    assert masks.item() == pytest.approx(0.0, abs=1e-3)
    assert quality.item() == 0.0


def test_contrastive_loss_matches_hand_computation():
    one = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    valid = torch.eye(2)
    # logits [[1, 0], [0, 1]]: -log(e / (e + 1)) = log(1 + 1/e) = 0.3133 in each row and column
    loss = contrastive_loss(one, one, valid, torch.tensor(1.0))
    assert loss.item() == pytest.approx(0.31326, abs=1e-4)
    # two crops that share both captions: the best any model can do is log 2
    same = torch.tensor([[1.0, 0.0], [1.0, 0.0]])
    loss = contrastive_loss(same, same, torch.ones(2, 2), torch.tensor(5.0))
    assert loss.item() == pytest.approx(np.log(2), abs=1e-5)


def test_learning_rate_rises_then_falls_to_two_percent():
    assert learning_rate(0, 100, 1.0, 10) == pytest.approx(0.1)
    assert learning_rate(9, 100, 1.0, 10) == pytest.approx(1.0)
    assert learning_rate(55, 100, 1.0, 10) == pytest.approx(0.02 + 0.98 / 2)
    assert learning_rate(100, 100, 1.0, 10) == pytest.approx(0.02)


def test_stages_follow_each_other():
    stages = (CropStage(0.5, 64, 1, 1), CropStage(0.5, 128, 1, 1))
    assert [stage_of_step(step, 4, stages).crop_px for step in range(4)] == [64, 64, 128, 128]


def test_levels_are_drawn_equally_often():
    views = drawn_views(2, 64)
    rough = [[RoughMask(views.labels[view, 0] == 3, 1)] for view in range(2)]
    crops = collect_crops(views, rough, seed=0)
    weights = crop_weights(crops, nothing=0.0)
    for level in (1, 2, 3):
        assert weights[crops.level == level].sum() == pytest.approx(1 / 3)
    assert weights[(crops.level == 1) & crops.rough].sum() == pytest.approx(0.4 / 3)


def test_a_segmenter_that_trusts_no_mask_gives_none(trained):
    encoder, decoder, _ = trained
    image = drawn_views(1, 64).images[0]
    assert segment_everything(encoder, decoder, image, 4, iou_min=1.1) == []
