"""Time to make a view's masks without the network: read logits, filter, suppress, build the tree, write.

Timings are processor time of one thread, without that of the network (a table of blobs, `canned_sam`).
Cases handle all 3 x 1024 outputs for a grid of 32 x 32 prompts.
"""

import time

import numpy as np
import pytest

from benchmarks.canned_sam import CannedSam, NetworkClock, blob_masks
from benchmarks.goals import Goal
from hilsplat.base.artifacts import write_npz
from hilsplat.segment.coverage import coverage_tree
from hilsplat.segment.generate import decode_candidates, masks_from_candidates
from hilsplat.segment.graph import segment_graph
from hilsplat.segment.suppression import suppress_masks
from hilsplat.settings import MasksSettings

# filters that drop nothing, so that the suppression gets 1024 candidates per level
SETTINGS = MasksSettings(
    points_per_batch=64, predicted_iou_min=0.7, stability_min=0.5, nms_score=0, min_area_px=100
)

VIEW_HW = (600, 800)
LANGSPLAT_HW = (728, 986)
VIEW = "view outside the network, 800x600, 3 x 1024 candidates, 1 thread"
AGAIN = "the same from the cache (other thresholds)"
SUPPRESS = "suppression of 1000 masks, 986x728, 1 thread"
CLOCK = NetworkClock()


@pytest.fixture(scope="module")
def model() -> CannedSam:
    return CannedSam(CLOCK)


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (*VIEW_HW, 3), dtype=np.uint8)


def finish(candidates, model, folder) -> int:
    """Write masks and tree of candidates, and return the number of masks."""
    masks = masks_from_candidates(candidates, VIEW_HW, model, SETTINGS)
    parent, depth = coverage_tree(masks, 0.9)
    masks.save(folder / "masks.npz")
    write_npz(folder / "tree.npz", parent=parent, depth=depth)
    return len(masks)


@pytest.mark.benchmark(timer=CLOCK, min_rounds=8, max_time=4.0)
def test_view(benchmark, model, image, tmp_path):
    def view() -> tuple[int, int]:
        candidates = decode_candidates(image, model, SETTINGS)
        write_npz(tmp_path / "cache.npz", **vars(candidates))
        return len(candidates.head), finish(candidates, model, tmp_path)

    benchmark.extra_info |= {"case": VIEW, "count": 1, "of": "views"}
    number, kept = benchmark(view)
    assert number == 3 * 1024
    assert kept > 200


@pytest.mark.benchmark(timer=time.process_time, min_rounds=8, max_time=2.0)
def test_view_from_cache(benchmark, model, image, tmp_path):
    candidates = decode_candidates(image, model, SETTINGS)
    benchmark.extra_info |= {"case": AGAIN, "count": 1, "of": "views"}
    assert benchmark(lambda: finish(candidates, model, tmp_path)) > 200


@pytest.mark.benchmark(timer=time.process_time, min_rounds=8, max_time=2.0)
def test_suppression(benchmark):
    masks = blob_masks(1000, LANGSPLAT_HW)
    benchmark.extra_info |= {"case": SUPPRESS, "count": 1000, "of": "masks"}
    kept = benchmark(lambda: suppress_masks(masks, iou_max=0.8, score_min=0.0, inner=0.5))
    assert 0 < len(kept) < 1000


@pytest.mark.benchmark(timer=time.process_time, min_rounds=4, max_time=4.0)
def test_graph(benchmark):
    rng = np.random.default_rng(0)
    blocks = rng.integers(0, 255, (15, 20, 3), dtype=np.uint8)
    image = np.repeat(np.repeat(blocks, 40, axis=0), 40, axis=1) // 2 + rng.integers(0, 30, (*VIEW_HW, 3))
    benchmark.extra_info |= {"case": "graph segmenter, 800x600, 1 thread", "count": 1, "of": "views"}
    masks = benchmark(lambda: segment_graph(image.astype(np.uint8), MasksSettings().graph_scales, 100))
    assert len(masks) > 100


GOALS = [
    Goal(VIEW, "s", 1.0, lambda t: t[VIEW] / 1e3),
    Goal(SUPPRESS, "s", 0.3, lambda t: t[SUPPRESS] / 1e3),
]
