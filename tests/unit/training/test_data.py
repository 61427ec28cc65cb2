"""Training data: windows, prompts and border maps of the segmenter; crops and captions of the small CLIP."""

import numpy as np
import pytest

from hilsplat.segment.crops import square_crop
from models.training.batches import compared_pixels, draw_level_prompts, region_edges
from models.training.clip import CROP_PX
from models.training.crops import Captioner, best_node, list_crops, list_segmented
from models.training.data import cut_window, nested_targets, region_centres
from models.training.train_clip import crop_weights
from tests.unit.training.drawn import drawn_masks, drawn_views


def test_best_node_prefers_the_level_of_the_mask_where_regions_coincide():
    labels = np.full((3, 4, 4), -1, int)
    labels[0, :2] = 0
    labels[1, :2] = 1
    mask = labels[0] == 0
    assert best_node(mask, 1, labels, 2) == (0, 1.0)
    assert best_node(mask, 2, labels, 2) == (1, 1.0)
    labels[0, 2] = 0  # now the whole has 12 pixels, 8 of them in the mask
    assert best_node(mask, 1, labels, 2) == (1, 1.0)


def test_crops_of_the_segmenter_are_captioned_by_overlap():
    views = drawn_views(1, 64)
    disc = views.labels[0, 0] == 3
    nothing = np.zeros((64, 64), bool)
    nothing[:6, :6] = True
    crops = list_crops(views, [drawn_masks((1, disc), (3, nothing))])
    assert crops.rough.tolist() == [False] * 4 + [True, True]
    texts = [crops.phrase_sets[row][0] for row in crops.caption[:5]]
    assert texts == ["ball", "coin", "ball half", "ball spot", "coin"]
    assert crops.caption[5] == -1
    assert crops.level.tolist() == [1, 1, 2, 3, 1, 0]
    # parts and their whole have the same thing
    assert crops.thing[:4].tolist() == [0, 3, 0, 0]


def test_captions_are_valid_for_every_crop_that_they_describe():
    captioner = Captioner((("ball", "red ball"), ("coin",)), generic_share=0.0, others=2)
    texts, valid = captioner.draw(np.random.default_rng(0), np.array([0, 0, 1]))
    assert texts[2].endswith("coin")
    assert valid[:2, :2].tolist() == [[1, 1], [1, 1]]
    assert valid[2, :3].tolist() == [0, 0, 1]
    # the three captions are followed by both queries and two of the three phrases
    assert texts[3:5] == ["ball", "coin"]
    assert valid.shape == (3, len(texts)) == (3, 7)
    for column, text in enumerate(texts):
        assert valid[:, column].tolist() == ([0, 0, 1] if text.endswith("coin") else [1, 1, 0])


def test_a_crop_equals_that_of_the_pipeline():
    views = drawn_views(1, 64)
    half = views.labels[0, 1] == 1
    crops = list_crops(views, [drawn_masks((2, half))])
    expected = square_crop(views.images[0], half, "black", 0.0, CROP_PX)
    exact = int(np.flatnonzero((crops.node == 1) & ~crops.rough)[0])
    segmented = int(np.flatnonzero(crops.rough)[0])
    for row in (exact, segmented):
        assert np.array_equal(crops.cut(row), expected)
    assert not np.array_equal(crops.cut(exact, rng=np.random.default_rng(0)), expected)  # roughened
    assert np.array_equal(list_segmented(views, [drawn_masks((2, half))]).cut(0), expected)


def test_levels_are_drawn_equally_often():
    views = drawn_views(2, 64)
    masks = [drawn_masks((1, views.labels[view, 0] == 3)) for view in range(2)]
    crops = list_crops(views, masks)
    weights = crop_weights(crops, nothing=0.0, rough=0.4)
    for level in (1, 2, 3):
        assert weights[crops.level == level].sum() == pytest.approx(1 / 3)
    assert weights[(crops.level == 1) & crops.rough].sum() == pytest.approx(0.4 / 3)


def test_prompts_reach_a_region_of_one_pixel():
    labels = np.zeros((3, 20, 20), int)
    labels[:, 7, 3] = 5
    points = draw_level_prompts(np.random.default_rng(0), labels, labels, 400, balanced=1.0)
    # probabilities grow with the fourth root of the area: 1 against 399 ** 0.25 = 4.47, so 18 % of 400
    on_pixel = (points == (3, 7)).all(axis=1).sum()
    assert 45 < on_pixel < 105


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
