"""Training lowers its losses, is deterministic and resumes; its measurements are correct."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from models.training.batches import CropStage
from models.training.clip import contrastive_loss
from models.training.crops import list_crops
from models.training.loop import Budget, Tuning, has_fast_half
from models.training.measure_clip import measure_clip, measure_queries
from models.training.measure_sam import measure_everything
from models.training.train_clip import train_clip
from models.training.train_sam import segmentation_loss, train_sam, training_loss
from tests.unit.training.drawn import drawn_masks, drawn_views

SMALL = (CropStage(1.0, 64, 4, 8, 128),)
WINDOWS = {"stages": SMALL, "grown_stages": (CropStage(1.0, 64, 2, 12, 96),)}
FAST = Tuning(peak=3e-3, warmup=4, average=0.8, measure_every=8, save_every=8)


def test_the_segmenter_learns(tmp_path):
    views, unseen = drawn_views(6, 64), drawn_views(2, 64, seed=9)
    _, _, curve = train_sam(views, unseen, Budget(steps=24), 0, tmp_path, **WINDOWS, tuning=FAST)
    assert [row["step"] for row in curve] == [8, 16, 24]
    assert curve[-1]["mask_loss"] < 0.8 * curve[0]["mask_loss"]
    assert curve[-1]["semantic_loss"] < curve[0]["semantic_loss"]


def weights_of(run) -> np.ndarray:
    return torch.cat([p.detach().flatten() for module in run[:2] for p in module.parameters()]).numpy()


def test_an_interrupted_and_extended_training_gives_the_weights_of_a_single_run(tmp_path, monkeypatch):
    views = drawn_views(2, 64)
    tuning = Tuning(peak=2e-3, warmup=2, measure_every=100, save_every=2)

    def train(steps, folder):
        return train_sam(views, views, Budget(steps=steps), 3, tmp_path / folder, **WINDOWS, tuning=tuning)

    whole = train(8, "a")
    steps = iter(range(4))

    def killed(*args):
        if next(steps) == 3:
            raise KeyboardInterrupt
        return training_loss(*args)

    with monkeypatch.context() as context, pytest.raises(KeyboardInterrupt):
        context.setattr("models.training.train_sam.training_loss", killed)
        train(4, "b")
    train(4, "b")
    assert np.array_equal(weights_of(whole), weights_of(train(8, "b")))


def test_a_budget_in_minutes_schedules_the_decay_from_the_speed():
    budget = Budget(minutes=40.0)
    assert not budget.is_time_to_decay(290, 29.0)
    assert budget.is_time_to_decay(300, 30.0)
    # ten steps per minute, ten minutes left
    assert budget.decay_steps(300, 30.0) == 100
    # already longer than the budget: the decay still gets a quarter of it
    assert budget.decay_steps(1000, 100.0) == 100
    with pytest.raises(ValueError, match="minutes or steps"):
        Budget()


@pytest.mark.parametrize(("major", "fast"), [(7, False), (8, True)])
def test_a_card_that_emulates_bfloat16_trains_in_float32(monkeypatch, major, fast):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(major=major))
    monkeypatch.setattr(torch.cuda, "_check_bf16_tensor_supported", lambda device: True)  # by emulation
    assert has_fast_half(torch.device("cuda")) == fast


def test_segmentation_loss_is_near_zero_for_the_ground_truth_and_ignores_unknown_heads():
    truth = torch.zeros(1, 1, 3, 64)
    truth[..., 16:48] = 1
    weights = torch.full((1, 1, 64), 2.0)
    right, wrong = (truth * 2 - 1) * 20, (1 - truth * 2) * 20
    known = torch.tensor([[[1.0, 1.0, 1.0]]])
    masks, quality = segmentation_loss(torch.ones(1, 1, 3), right, truth, weights, known)
    assert masks.item() < 1e-3 and quality.item() < 1e-6
    one_wrong = torch.cat([right[:, :, :2], wrong[:, :, 2:]], dim=2)
    partly = torch.tensor([[[1.0, 1.0, 0.0]]])
    assert sum(segmentation_loss(partly, one_wrong, truth, weights, partly)).item() < 1e-3


def test_recall_counts_regions_matched_at_their_level():
    views = drawn_views(1, 64)
    labels = views.labels[0]
    masks = drawn_masks((1, labels[0] == 0), (1, labels[1] == 1))
    found = measure_everything([masks], views)
    # the ball is found, the coin is not; the mask of the half has the level of wholes, where it fits nothing
    assert (found["whole"]["recall"], found["whole"]["n"]) == (0.5, 2)
    assert found["part"]["recall"] == 0.0


def test_clip_learns_and_is_measured(tmp_path):
    views, unseen = drawn_views(6, 64), drawn_views(2, 64, seed=9)
    masks = [drawn_masks((1, of[0] == 0), (1, of[0] == 3), (2, of[1] == 1)) for of in unseen.labels]
    crops, others = list_crops(views), list_crops(unseen, masks)
    clip, curve = train_clip(crops, others, Budget(steps=40), 0, tmp_path, batch=24, tuning=FAST)
    assert curve[-1]["contrastive_loss"] < curve[0]["contrastive_loss"]
    assert curve[-1]["exact_whole"] > 0.5
    found = measure_clip(clip, others)
    assert found[("rough", "whole")]["n"] == 4
    queries = measure_queries(clip, unseen, masks)
    # the masks are ground truth, so a correct answer has IoU 1, and every text names one region
    assert queries["whole"]["best"] == 1.0
    assert queries["whole"]["iou"] > 0.5
    assert queries["subpart"]["iou"] == 0.0  # no mask of that level was given


def test_contrastive_loss_matches_hand_computation():
    one = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    valid = torch.eye(2)
    # logits [[1, 0], [0, 1]]: -log(e / (e + 1)) = log(1 + 1/e) = 0.3133 in each row and column
    loss = contrastive_loss(one, one, valid, torch.tensor(1.0))
    assert loss.item() == pytest.approx(0.31326, abs=1e-4)
    # a third text describes neither and is only a negative: log(2 + e) - 1 = 0.5514 by image, 0.3133 by text
    three = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    loss = contrastive_loss(one, three, torch.eye(2, 3), torch.tensor(1.0))
    assert loss.item() == pytest.approx((0.55144 + 0.31326) / 2, abs=1e-4)
