"""Levels by depth in the coverage tree, whatever the segmenter called them."""

import numpy as np

from hilsplat.base.artifacts import ViewCache
from hilsplat.base.levels import Level
from hilsplat.scene.scene import Scene
from hilsplat.segment.coverage_levels import with_coverage_levels
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.stage import graph_masks
from hilsplat.settings import MasksSettings

SETTINGS = MasksSettings(level_source="coverage")


def disc(radius: float, centre: float = 30) -> np.ndarray:
    y, x = np.mgrid[:60, :60]
    return np.hypot(x - centre, y - centre) < radius


def pack(masks: list[np.ndarray], level: list[int], iou: list[float] | None = None) -> HierarchicalMasks:
    scores = np.array(iou or [0.9] * len(masks), np.float32)
    return HierarchicalMasks.from_dense(
        np.stack(masks), np.array(level, np.uint8), scores, np.ones(len(masks), np.float32)
    )


def test_nested_masks_of_one_head_get_three_levels():
    masks = with_coverage_levels(pack([disc(25), disc(15), disc(6)], [3, 3, 3]), SETTINGS)
    assert masks.level.tolist() == [1, 2, 3]
    assert (np.diff(masks.area_px) < 0).all()


def test_masks_beside_each_other_are_wholes():
    apart = [disc(8, 12), disc(8, 45)]
    assert with_coverage_levels(pack(apart, [3, 2]), SETTINGS).level.tolist() == [1, 1]


def test_the_same_mask_of_two_heads_stays_once_with_the_better_score():
    masks = with_coverage_levels(pack([disc(20), disc(20.3), disc(8)], [1, 2, 3], [0.7, 0.8, 0.9]), SETTINGS)
    assert masks.level.tolist() == [1, 2]
    np.testing.assert_allclose(masks.predicted_iou, [0.8, 0.9], rtol=1e-6)


def test_what_is_deeper_than_three_is_a_subpart_and_nests_nowhere():
    rings = [disc(radius) for radius in (28, 19, 12, 7)]
    masks = with_coverage_levels(pack(rings, [1, 1, 1, 1]), SETTINGS)
    # the fourth lies in the third; both would be subparts, and the inner rule drops the contained one
    assert masks.level.tolist() == [1, 2, 3]
    kept = with_coverage_levels(pack(rings, [1] * 4), SETTINGS.model_copy(update={"nms_inner": 0.0}))
    assert kept.level.tolist() == [1, 2, 3, 3]


def test_no_masks_have_no_levels():
    assert len(with_coverage_levels(HierarchicalMasks.concatenate([], (4, 4)), SETTINGS)) == 0


def test_the_stage_passes_the_choice_on(make_scene, tmp_path):
    scene = Scene.load(make_scene(views=2, size_hw=(64, 64)))
    cache = ViewCache(tmp_path / "cache")
    by_scale = graph_masks(scene, "000.png", cache, MasksSettings(segmenter="graph"))
    by_depth = graph_masks(scene, "000.png", cache, MasksSettings(segmenter="graph", level_source="coverage"))
    assert cache.hits == 1  # the segmentation itself is the same
    overlap = by_depth.overlaps_px()
    union = by_depth.area_px[:, None] + by_depth.area_px[None] - overlap
    assert (overlap / union)[~np.eye(len(by_depth), dtype=bool)].max(initial=0) <= 0.8
    assert len(by_depth) < len(by_scale)
    assert len(by_depth.rows_of(Level.WHOLE)) >= 1
