"""Candidates produce the same masks as the decoder's whole output."""

import numpy as np
import pytest

from hilsplat.segment.generate import Candidates, distinct_prompts, keep_candidates, masks_from_candidates
from hilsplat.segment.sam import Encoded, Frame, Prompts, SamModel, Thresholds, enlarged, resized_size
from hilsplat.settings import MasksSettings
from tests.unit.segment.plain import flatten_far, quantise, smooth_logits, unpacked

EVERYTHING = MasksSettings(
    predicted_iou_min=0, stability_min=0, nms_score=0, min_area_px=1, box_nms_iou=1, nms_iou=1, nms_inner=0
)
NOTHING_DROPPED = Thresholds(predicted_iou_min=0.0, stability_min=0.0, nms_score=0.0, points_per_batch=64)


def candidates_of(logits: np.ndarray, frame: Frame) -> Candidates:
    """All heads of all prompts, none dropped."""
    scores = np.linspace(0.5, 1, len(logits) * 3, dtype=np.float32).reshape(-1, 3)
    return keep_candidates(scores, logits, frame, 0, EVERYTHING, NOTHING_DROPPED)


def test_windows_contain_the_band_around_edges() -> None:
    logits = smooth_logits(12, 48, seed=3)
    kept = candidates_of(logits.reshape(4, 3, 48, 48), Frame((48, 48), (48, 48), (48, 48)))
    assert len(kept) == 12
    np.testing.assert_array_equal(unpacked(kept), [flatten_far(steps) for steps in quantise(logits)])


@pytest.mark.parametrize(
    "original_hw", [(32, 24), (100, 128), (256, 256), (480, 640), (728, 986), (300, 3), (1, 200), (64, 1)]
)
def test_masks_from_windows_equal_enlarged_masks(original_hw: tuple[int, int], disc_sam) -> None:
    model = SamModel.load(disc_sam)
    model.longest_edge, model.padded_hw = 256, (256, 256)
    frame = Frame(original_hw, resized_size(original_hw, 256), (256, 256))
    logits = smooth_logits(30, 64, seed=sum(original_hw))
    kept = candidates_of(logits.reshape(10, 3, 64, 64), frame)
    masks = masks_from_candidates(kept, original_hw, model, EVERYTHING)
    expected = [mask for mask in enlarged(quantise(logits).astype(np.float32), frame) if mask.any()]
    found = list(masks.dense())
    assert len(found) == len(expected) > 5
    for mask in found:  # rounding may decide on the border itself
        assert min((mask != other).mean() for other in expected) < 2e-4


def test_full_masks_have_no_edge_and_empty_ones_are_dropped() -> None:
    frame = Frame((8, 8), (8, 8), (8, 8))
    kept = candidates_of(np.full((1, 3, 8, 8), 3, np.float32), frame)
    np.testing.assert_array_equal(unpacked(kept), np.full((3, 8, 8), 127))
    assert len(candidates_of(np.full((2, 3, 8, 8), -3, np.float32), frame)) == 0


class Previewed(SamModel):
    """A SAM whose previews are given scores and discs (centre x, radius) in 16 x 16 px."""

    def __init__(self, scores: list[list[float]], discs: list[list[tuple[float, float]]]) -> None:
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


def test_prompts_with_a_mask_that_repeats_no_better_one_are_kept() -> None:
    small, middle, large = (8, 2.2), (8, 4.2), (8, 6.2)
    scores = [[0.5, 0.5, 0.5], [0.6, 0.5, 0.5], [0.5, 0.5, 0.4], [0.4, 0.4, 0.05]]
    discs = [[small, middle, large]] * 2 + [[small, (4, 3.2), large], [small, middle, (9, 6.2)]]
    # 0 is as good as 1 at two heads, and the earlier; 1 is better at the first; 2 shows another part; the
    # other whole of 3 is below the floor of 0.1
    assert prompts_of(Previewed(scores, discs)) == [0, 1, 2]


def test_one_prompt_is_kept_if_the_preview_is_empty() -> None:
    assert prompts_of(Previewed([[0.05] * 3] * 3, [[(8, 3)] * 3] * 3)) == [0]
