"""Thresholds come with the model, and scores are kept as the network gives them."""

import json

import numpy as np
import pytest

from hilsplat.base.errors import ModelError
from hilsplat.embed.model_check import check_model
from hilsplat.segment.candidates import decode_candidates
from hilsplat.segment.generate import masks_from_candidates
from hilsplat.segment.sam import REAL_SAM, Encoded, SamModel, Thresholds
from hilsplat.settings import MasksSettings
from models.training.export import OWN_THRESHOLDS
from tests.conftest import PROJECT


def without_own(folder, **config):
    (folder / "config.json").write_text(json.dumps({"model_type": "sam", **config}))
    return folder


def test_a_released_sam_has_langsplats_thresholds(make_disc_sam, tmp_path):
    model = SamModel.load(without_own(make_disc_sam(tmp_path / "sam")))
    assert model.thresholds(MasksSettings()) == REAL_SAM == Thresholds(0.7, 0.85, 0.7, 8)


def test_the_embedded_sam_brings_its_own():
    model = SamModel.load(PROJECT / "models/sam-tiny")
    assert model.thresholds(MasksSettings()) == OWN_THRESHOLDS == Thresholds(0.35, 0.5, 0.0, 16)


def test_check_prints_the_thresholds_of_a_model():
    text = check_model(PROJECT / "models/sam-tiny")
    assert "thresholds predicted IoU 0.35, stability 0.5, score 0.0" in text


def test_a_setting_wins_over_the_model(disc_sam):
    chosen = MasksSettings(stability_min=0.9, points_per_batch=3)
    assert SamModel.load(disc_sam).thresholds(chosen) == Thresholds(0.35, 0.9, 0.0, 3)


@pytest.mark.parametrize("own", [{"stability_min": 3}, {"segmenter": "graph"}, [1]])
def test_thresholds_that_cannot_be_used_are_named(make_disc_sam, tmp_path, own):
    folder = without_own(make_disc_sam(tmp_path / "sam"), mask_generation=own)
    with pytest.raises(ModelError, match=r"config.json: mask_generation cannot be used"):
        SamModel.load(folder)


def test_of_two_masks_above_one_the_surer_stays(disc_sam):
    """The network is surer of the smaller disc: 1.06 and 1.02. Cut to 1, the larger would win the tie."""

    class Sure(SamModel):
        def decode(self, encoded: Encoded, points_xy: np.ndarray):
            y, x = np.mgrid[:16, :16]
            radii = np.where(np.arange(len(points_xy)) == 0, 5.2, 4.8)
            discs = (radii[:, None, None] - np.hypot(x - 7.5, y - 7.5)[None]).astype(np.float32)
            scores = np.where(np.arange(len(points_xy)) == 0, 1.02, 1.06).astype(np.float32)
            return np.repeat(scores[:, None], 3, axis=1), np.repeat(discs[:, None], 3, axis=1)

    loaded = SamModel.load(disc_sam)
    model, chosen = Sure(loaded.model), MasksSettings(points_per_side=2, stability_min=0, min_area_px=1)
    candidates = decode_candidates(np.zeros((32, 32, 3), np.uint8), model, chosen)
    assert candidates.predicted_iou.max() == np.float32(1.06)
    masks = masks_from_candidates(candidates, (32, 32), model, chosen)
    assert masks.predicted_iou.tolist() == [np.float32(1.06)] * 3


@pytest.mark.parametrize(
    ("key", "values"),
    [("image_std", [0, 1, 1]), ("image_std", [-1, 1, 1]), ("image_std", "x"), ("image_mean", [1e999, 0, 0])],
)
def test_statistics_that_no_image_has_are_refused(make_disc_sam, tmp_path, key, values):
    folder = make_disc_sam(tmp_path / "sam")
    described = json.loads((folder / "preprocessor_config.json").read_text())
    (folder / "preprocessor_config.json").write_text(json.dumps({**described, key: values}))
    with pytest.raises(ModelError, match=f"{key} cannot be used"):
        SamModel.load(folder)
