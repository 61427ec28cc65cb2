"""Windows, prompts, rough masks and captions for the small models."""

import numpy as np
import pytest

from hilsplat.world.tiny.clip import CANONICAL
from hilsplat.world.tiny.data import (
    Captioner,
    RoughMask,
    best_node,
    collect_crops,
    cut_window,
    draw_prompts,
    nested_targets,
    region_centres,
    roughen,
)
from tests.unit.world.tiny.drawn import drawn_views


def test_a_missing_subpart_is_its_part_and_a_missing_part_its_whole():
    labels = np.array([[[0, 0, 0, -1]], [[1, 1, -1, -1]], [[2, -1, -1, -1]]])
    subpart, part, whole = nested_targets(labels)
    assert subpart.tolist() == [[2, 1, 0, -1]]
    assert part.tolist() == [[1, 1, 0, -1]]
    assert whole.tolist() == [[0, 0, 0, -1]]


def test_balanced_prompts_reach_a_region_of_one_pixel():
    targets = np.zeros((3, 20, 20), int)
    targets[:, 7, 3] = 5
    points = draw_prompts(np.random.default_rng(0), targets, 64, balanced=1.0)
    # two regions, so about half of the prompts fall on the single pixel (x 3, y 7)
    on_pixel = (points == (3, 7)).all(axis=1).sum()
    assert 16 < on_pixel < 48


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
        example = cut_window(np.random.default_rng(seed), views.images[0], views.labels[0], 48)
        assert example.image.shape == (48, 48, 3)
        green = (example.image[..., 1] > 150) & (example.image[..., 0] < 80)
        agree = (green == (example.labels[0] == 3)).mean()
        assert agree > 0.97  # edges are mixed where the window was resized
        x0, y0, side = example.window
        assert x0 >= 0 and y0 >= 0 and max(x0, y0) + side <= 1


def test_best_node_prefers_the_level_that_drew_the_mask_where_regions_coincide():
    labels = np.full((3, 4, 4), -1, int)
    labels[0, :2] = 0
    labels[1, :2] = 1
    mask = labels[0] == 0
    assert best_node(mask, 1, labels, 2) == (0, 1.0)
    assert best_node(mask, 2, labels, 2) == (1, 1.0)
    labels[0, 2] = 0  # now the whole has 12 pixels, 8 of them in the mask
    assert best_node(mask, 1, labels, 2) == (1, 1.0)


def test_roughened_masks_resemble_the_mask():
    mask = np.zeros((64, 64), bool)
    mask[16:48, 16:48] = True
    for seed in range(20):
        rough = roughen(np.random.default_rng(seed), mask)
        iou = (mask & rough).sum() / (mask | rough).sum()
        assert 0.5 < iou <= 1


def test_crops_of_the_segmenter_are_captioned_by_overlap():
    views = drawn_views(1, 64)
    disc = views.labels[0, 0] == 3
    nothing = np.zeros((64, 64), bool)
    nothing[:6, :6] = True
    crops = collect_crops(views, [[RoughMask(disc, 1), RoughMask(nothing, 3)]], seed=0, jitter=False)
    assert crops.rough.tolist() == [False] * 4 + [True, True]
    assert [crops.phrase_sets[row][0] for row in crops.captions[:5]] == [
        "ball",
        "coin",
        "ball half",
        "ball spot",
        "coin",
    ]
    assert crops.captions[5] == -1


def test_captions_are_valid_for_every_crop_they_are_true_of():
    captioner = Captioner((("ball", "red ball"), ("coin",)), generic_share=0.0)
    texts, valid = captioner.draw(np.random.default_rng(0), np.array([0, 0, 1]))
    assert texts[2].endswith("coin")
    assert valid[:2, :2].tolist() == [[1, 1], [1, 1]]
    assert valid[2].tolist() == [0, 0, 1]


def test_canonical_phrases_describe_only_the_crops_they_were_drawn_for():
    captioner = Captioner((("ball",),), generic_share=0.5)
    texts, valid = captioner.draw(np.random.default_rng(1), np.zeros(40, int))
    generic = np.array([any(phrase in text for phrase in CANONICAL) for text in texts])
    assert 8 < generic.sum() < 32
    # a crop captioned "object" has that caption and, being a ball, all balls' captions
    assert valid[np.ix_(~generic, generic)].sum() == 0
    assert valid[:, ~generic].all()
