"""Likely pairs share a place or follow each other; gaps between groups and weak ends are tried again."""

import numpy as np
import pytest

from hilsplat.scene import pairing


def views_of_places(rng, places, each):
    """Descriptors of views, place by place: each view shows 40 of its place's 60 features, with noise."""
    views = []
    for _ in range(places):
        features = rng.exponential(40, (60, 128))
        for _ in range(each):
            shown = features[rng.permutation(60)[:40]] + rng.normal(0, 12, (40, 128))
            views.append(shown.clip(0, 255).astype(np.uint8))
    return views


def test_views_of_one_place_are_the_most_similar():
    vectors = pairing.appearance_vectors(views_of_places(np.random.default_rng(2), 5, 4), seed=0)
    likeness = vectors @ vectors.T
    nearest = np.argsort(-likeness, axis=1)[:, :4]
    assert (nearest // 4 == np.arange(20)[:, None] // 4).all()


def test_products_of_appearance_vectors_are_exact():
    views = [*views_of_places(np.random.default_rng(3), 4, 3), np.zeros((0, 128), np.uint8)]
    vectors = pairing.appearance_vectors(views, seed=0)
    exact = vectors.astype(np.int64) @ vectors.astype(np.int64).T
    assert (vectors @ vectors.T == exact).all() and exact.max() < 2**24
    assert not vectors[-1].any()  # no features
    assert np.diag(exact)[:-1] == pytest.approx(pairing.LENGTH**2, rel=0.02)


@pytest.mark.parametrize("count", [0, 3])
def test_captures_without_features_have_empty_vectors(count):
    vectors = pairing.appearance_vectors([np.zeros((0, 128), np.uint8)] * count, seed=0)
    assert len(vectors) == count and not vectors.any()


def test_words_are_the_centres_of_clusters(monkeypatch):
    monkeypatch.setattr(pairing, "WORDS", 2)
    cluster = np.array([[0, 2], [2, 0], [2, 2], [0, 0]], np.uint8)
    words = pairing.visual_words(np.concatenate([cluster, cluster + np.uint8(100)]), seed=0)
    assert sorted(words.tolist()) == [[1, 1], [101, 101]]


def test_likely_pairs_are_the_most_similar_and_neighbours_in_time(monkeypatch):
    monkeypatch.setattr(pairing, "NEAREST", 1)
    monkeypatch.setattr(pairing, "TIME_STEPS", 1)
    likeness = np.array([[9, 5, 1, 0], [5, 9, 1, 0], [1, 2, 9, 1], [3, 0, 1, 9]], np.float32)
    # the most similar of 0 to 3 are 1, 0, 1 and 0
    assert pairing.likely_pairs(likeness, [2, 3, 1, 0]) == {(0, 1), (1, 2), (0, 3)} | {(2, 3), (1, 3)}


def test_groups_are_numbered_by_size():
    assert pairing.groups_of(7, [(4, 6), (2, 4), (1, 3)]).tolist() == [2, 1, 0, 1, 0, 3, 0]
    assert pairing.groups_of(2, []).tolist() == [0, 1]


def test_other_groups_and_weak_views_are_tried_again(monkeypatch):
    monkeypatch.setattr(pairing, "NEAREST", 1)
    monkeypatch.setattr(pairing, "WEAK_PARTNERS", 2)
    # 0 to 4 are a ring with a tail (4), 5 and 6 another group; a view is similar to those with near numbers
    verified = [(0, 1), (1, 2), (2, 3), (0, 3), (3, 4), (5, 6)]
    rows = np.arange(7)
    likeness = -np.abs(rows[:, None] - rows).astype(np.float32)
    tried = {*verified, (2, 4)}
    weak = {(4, 5), (0, 4)}  # the tail's next most similar view, and its partner's partners (2 was tried)
    others = {(4, 5), (4, 6)}  # the views of the main group that are most similar to 5 and 6
    assert pairing.joining_pairs(likeness, tried, verified) == weak | others
    assert pairing.joining_pairs(likeness, tried, [*verified, (0, 4), (4, 5), (4, 6)]) == set()
