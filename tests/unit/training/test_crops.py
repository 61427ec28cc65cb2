"""Crops for the small CLIP: their pixels, roughened masks and captions."""

import numpy as np
import pytest

from hilsplat.segment.crops import square_crop
from models.training.clip import CANONICAL, CROP_PX
from models.training.crops import Captioner, best_node, list_crops, list_segmented, roughen
from models.training.measure_clip import coloured_text
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


def test_canonical_phrases_describe_only_the_crops_they_were_drawn_for():
    captioner = Captioner((("ball",),), generic_share=0.5)
    texts, valid = captioner.draw(np.random.default_rng(1), np.zeros(40, int))
    texts, valid = texts[:40], valid[:, :40]
    generic = np.array([any(phrase in text for phrase in CANONICAL) for text in texts])
    assert 8 < generic.sum() < 32
    # a crop captioned "object" has that caption and, because it is a ball, all captions of balls
    assert valid[np.ix_(~generic, generic)].sum() == 0
    assert valid[:, ~generic].all()


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


def test_the_phrase_of_colour_and_class_is_found():
    assert coloured_text(("kettle lid", "orange kettle lid", "striped kettle lid")) == "orange kettle lid"
    assert coloured_text(("kettle lid", "orange striped kettle lid")) is None
