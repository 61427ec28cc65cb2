"""Peak memory of a view's masks beside the model (Linux: the peak can be reset)."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.canned_sam import CannedSam, NetworkClock
from hilsplat.segment.coverage import coverage_tree
from hilsplat.segment.generate import decode_candidates, masks_from_candidates
from hilsplat.settings import MasksSettings

CLEAR = Path("/proc/self/clear_refs")


def status_mib(name: str) -> float:
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name)]
    return int(line.split()[1]) / 1024


@pytest.mark.skipif(not CLEAR.exists(), reason="needs /proc of Linux to reset the peak of memory")
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
