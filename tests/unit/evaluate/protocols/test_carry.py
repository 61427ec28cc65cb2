"""Which Gaussians a point takes its label or feature from, and with what weight."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.evaluate.protocols.carry import classify, density, frozen, nearest, vote

MEANS = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
OPAQUE = np.array([0.9, 0.5, 0.9])
LABELS = np.array([1, 2, 3])
IDENTITY = np.array([[1.0, 0, 0, 0]] * 3)


def points_at(*xs):
    return np.array([[x, 0.0, 0.0] for x in xs])


def test_frozen_gaussians_are_the_points_and_transparent_ones_are_not_scored():
    carried = frozen(np.array([0.09, 0.1, 0.8]), 3)
    assert carried.labels(LABELS).tolist() == [1, 2, 3]
    assert carried.truth(np.array([5, 6, 7])).tolist() == [0, 6, 7]
    with pytest.raises(MisalignedArtifactError, match=r"expected  4 Gaussians, one per point"):
        frozen(np.ones(3), 4)


def test_nearest_skips_transparent_gaussians():
    assert nearest(points_at(0.9, 100), MEANS, OPAQUE).labels(LABELS).tolist() == [2, 3]
    transparent = np.array([0.9, 0.05, 0.9])
    assert nearest(points_at(0.9, 1.1), MEANS, transparent).labels(LABELS).tolist() == [1, 3]
    with pytest.raises(MisalignedArtifactError, match=r"3 Gaussians, all below"):
        nearest(points_at(0.0), MEANS, np.full(3, 0.01))


def test_vote_weighs_by_opacity_within_the_radius():
    # at 0.9 all three are within 1.2: 0.9 for label 1, 0.5 + 0.9 for label 2
    carried = vote(points_at(0.9), MEANS, OPAQUE, radius=1.2)
    assert carried.mode == "vote of 5 within 1.2"
    assert carried.labels(np.array([1, 2, 2])).tolist() == [2]
    np.testing.assert_allclose(np.sort(carried.weight[0])[-3:], np.array([0.5, 0.9, 0.9]) / 2.3)
    # within 1 only the first two: 0.9 against 0.5
    assert vote(points_at(0.9), MEANS, OPAQUE, radius=1.0).labels(np.array([1, 2, 2])).tolist() == [1]


def test_radius_includes_its_border_and_nothing_beyond():
    carried = vote(points_at(2.1, 2.2), MEANS, OPAQUE, radius=2.1 - 2)
    assert carried.labels(LABELS).tolist() == [3, 0]
    assert carried.features(np.eye(3))[1].tolist() == [0, 0, 0]


def test_equal_votes_go_to_the_smaller_label_and_unlabelled_gaussians_have_none():
    even = np.full(3, 0.5)
    carried = vote(points_at(1.0), MEANS, even, radius=1.0)
    assert carried.labels(np.array([3, 1, 2])).tolist() == [1]
    assert carried.labels(np.array([0, 0, 2])).tolist() == [2]
    assert carried.labels(np.zeros(3, dtype=int)).tolist() == [0]


def test_density_follows_the_falloff_of_a_gaussian():
    # scale 1 at x = 0.5 between 0 and 1, both at distance 0.5; the third at 1.5
    carried = density(points_at(0.5), MEANS, OPAQUE, np.ones((3, 3)), IDENTITY)
    alpha = OPAQUE * np.exp(-np.array([0.25, 0.25, 2.25]) / 2)
    np.testing.assert_allclose(carried.features(np.eye(3))[0], alpha / alpha.sum())
    far = density(points_at(1e4), MEANS, OPAQUE, np.full((3, 3), 0.01), IDENTITY)
    assert far.labels(LABELS).tolist() == [3]  # relative weights are used far from all Gaussians


def test_density_turns_with_the_gaussian():
    # two at the origin, long along x, turned by 30 and -30 degrees about z; the point lies 2 away at 30
    half = np.deg2rad(15)
    quats = np.array([[np.cos(half), 0, 0, np.sin(half)], [np.cos(half), 0, 0, -np.sin(half)]])
    scales = np.array([[2.0, 0.5, 1]] * 2)
    point = 2 * np.array([[np.sqrt(3) / 2, 1 / 2, 0]])
    carried = density(point, np.zeros((2, 3)), np.full(2, 0.5), scales, quats)
    # the first: one standard deviation. The second sees it at 60 degrees: (1 / 2)**2 + (sqrt(3) / 0.5)**2
    alpha = np.exp([-1 / 2, -12.25 / 2])
    np.testing.assert_allclose(carried.features(np.eye(2))[0], alpha / alpha.sum())
    unnormalised = density(point, np.zeros((2, 3)), np.full(2, 0.5), scales, 7 * quats)
    np.testing.assert_allclose(unnormalised.weight, carried.weight)


coordinates = st.lists(st.tuples(*[st.integers(-5, 5)] * 3), min_size=1, max_size=12)


@settings(max_examples=25, deadline=None)
@given(coordinates, coordinates, st.integers(1, 4))
def test_weights_are_shares_and_threads_change_nothing(points, means, k):
    points, means = np.array(points, float), np.array(means, float)
    opacities = np.linspace(0.2, 0.9, len(means))
    scales, quats = np.full((len(means), 3), 0.7), np.array([[1.0, 0, 0, 0]] * len(means))
    for threads in (1, 2):
        carried = density(points, means, opacities, scales, quats, k, threads)
        assert (carried.weight >= 0).all()
        np.testing.assert_allclose(carried.weight.sum(axis=1), 1)
        one = density(points, means, opacities, scales, quats, k)
        np.testing.assert_array_equal(carried.index, one.index)
        np.testing.assert_array_equal(carried.weight, one.weight)


@settings(max_examples=25, deadline=None)
@given(coordinates, st.randoms(use_true_random=False))
def test_order_of_points_does_not_matter(points, random):
    points = np.array(points, float)
    order = random.sample(range(len(points)), len(points))
    carried, other = (vote(each, MEANS, OPAQUE, 3.0) for each in (points, points[order]))
    np.testing.assert_array_equal(carried.labels(LABELS)[order], other.labels(LABELS))


def test_classes_follow_the_cosine_whatever_the_length_and_the_first_wins_ties():
    texts = np.array([[1.0, 0], [0, 1]])
    features = np.array([[0.1, 0.2], [30.0, 20.0], [0.0, 0.0], [0.5, 0.5], [-0.3, -0.1]])
    assert classify(features, texts).tolist() == [2, 1, 0, 1, 2]
    assert classify(np.zeros((0, 2)), texts).shape == (0,)
