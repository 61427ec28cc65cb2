"""Windows, prompts, sampled mask pixels and border maps of the segmenter's training."""

import numpy as np
import pytest

from models.training.batches import compared_pixels, draw_level_prompts, region_edges
from models.training.data import cut_window, nested_targets, region_centres
from tests.unit.training.drawn import drawn_views


def test_prompts_reach_a_region_of_one_pixel():
    labels = np.zeros((3, 20, 20), int)
    labels[:, 7, 3] = 5
    points = draw_level_prompts(np.random.default_rng(0), labels, labels, 400, balanced=1.0)
    # probabilities grow with the fourth root of the area: 1 against 399 ** 0.25 = 4.47, so 18 % of 400
    on_pixel = (points == (3, 7)).all(axis=1).sum()
    assert 45 < on_pixel < 105


def test_a_window_without_parts_is_prompted_in_its_wholes():
    labels = np.full((3, 8, 8), -1)
    labels[0, 2:4, 2:4] = 0
    points = draw_level_prompts(np.random.default_rng(0), labels, nested_targets(labels), 50, balanced=1.0)
    assert (labels[0, points[:, 1], points[:, 0]] == 0).all()


def test_weighted_samples_estimate_areas():
    blocks = np.full((3, 64, 64, 4), -1)
    blocks[:, 10:20, 30:50] = 0  # 200 mask pixels
    blocks[0, 12:14, 33:35] = 1  # 4 of them are a subpart
    chosen = np.array([[1, 0, 0]])
    places, weights, truth = compared_pixels(np.random.default_rng(0), blocks, chosen, 65536)
    assert weights[0].sum() == pytest.approx(64 * 64, rel=0.05)
    areas = (weights[:, None] * truth).sum(axis=-1)[0]
    assert areas == pytest.approx([4, 200, 200], rel=0.1)
    y, x = np.divmod(places[0], 64)
    assert truth[0, 0].astype(bool).tolist() == ((y // 2 == 6) & (x >= 33) & (x < 35)).tolist()


def test_edges_are_on_both_sides_of_a_border():
    blocks = np.full((1, 2, 4, 1), 0)
    blocks[0, :, 2:] = 1
    assert region_edges(blocks)[0].tolist() == [[0, 1, 1, 0]] * 2


def test_a_missing_subpart_is_its_part_and_a_missing_part_its_whole():
    labels = np.array([[[0, 0, 0, -1]], [[1, 1, -1, -1]], [[2, -1, -1, -1]]])
    subpart, part, whole = nested_targets(labels)
    assert subpart.tolist() == [[2, 1, 0, -1]]
    assert part.tolist() == [[1, 1, 0, -1]]
    assert whole.tolist() == [[0, 0, 0, -1]]


def test_offsets_point_to_the_centre_of_the_region():
    targets = np.full((3, 1, 5), -1)
    targets[:, 0, 1:4] = 8  # x 1, 2, 3: centre 2
    offsets, known = region_centres(targets)
    assert known[0].tolist() == [[False, True, True, True, False]]
    assert offsets[0, 0, 1:4] == pytest.approx([1 / 32, 0, -1 / 32])
    assert offsets[1, 0, 1:4] == pytest.approx([0, 0, 0])


def test_a_window_keeps_pixels_and_labels_together():
    views = drawn_views(1, 64)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        image, labels, (x0, y0, side) = cut_window(rng, views.images[0], views.labels[0], 48)
        assert image.shape == (48, 48, 3)
        green = (image[..., 1] > 150) & (image[..., 0] < 80)
        assert (green == (labels[0] == 3)).mean() > 0.97  # edges are mixed where the window was resized
        assert x0 >= 0 and y0 >= 0 and max(x0, y0) + side <= 1
