"""Gaussians assigned to points, with weights, and the labels and features transferred from them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.evaluate.protocols.carry import carried_to, classify
from hilsplat.splat.gaussians import Gaussians

MEANS = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
OPAQUE = np.array([0.9, 0.5, 0.9])
LABELS = np.array([1, 2, 3])


def gaussians_of(opacities=OPAQUE, means=MEANS, scales=(1.0, 1, 1), quats=((1, 0, 0, 0),)):
    """Gaussians whose opacities and scales are exact, not rounded through their logits and logarithms."""

    class Exact(Gaussians):
        pass

    Exact.opacities = np.array(opacities, float)
    Exact.scales = np.broadcast_to(np.array(scales, float), (len(means), 3))
    n = len(means)
    turns = np.array(np.broadcast_to(quats, (n, 4)), np.float32)
    rest = np.zeros((n, 3), np.float32), turns, np.zeros(n, np.float32), np.zeros((n, 1, 3), np.float32)
    return Exact(np.array(means, np.float32), *rest)


def carried(xs, mode, gaussians=None, radius=0.0):
    """Assign Gaussians, by default the three on the x axis, to the points (x, 0, 0)."""
    points = np.array([[x, 0.0, 0.0] for x in xs])
    return carried_to(points, gaussians_of() if gaussians is None else gaussians, mode, radius)


def test_frozen_gaussians_are_the_points_and_transparent_ones_are_not_scored():
    found = carried([0, 1, 2], "frozen", gaussians_of([0.09, 0.1, 0.8]))
    assert found.labels(LABELS).tolist() == [1, 2, 3]
    assert found.is_scored.tolist() == [False, True, True]
    with pytest.raises(MisalignedArtifactError, match=r"expected  4 Gaussians, one per point"):
        carried([0, 1, 2, 3], "frozen")


def test_nearest_skips_transparent_gaussians():
    assert carried([0.9, 100], "nearest").labels(LABELS).tolist() == [2, 3]
    transparent = gaussians_of([0.9, 0.05, 0.9])
    assert carried([0.9, 1.1], "nearest", transparent).labels(LABELS).tolist() == [1, 3]
    with pytest.raises(MisalignedArtifactError, match=r"3 Gaussians, all below"):
        carried([0.0], "nearest", gaussians_of([0.01] * 3))


def test_vote_weighs_by_opacity_within_the_radius():
    # at 0.9 all three are within 1.2: 0.9 for label 1, 0.5 + 0.9 for label 2
    found = carried([0.9], "vote", radius=1.2)
    assert found.mode == "vote of 5 within 1.2"
    assert found.labels(np.array([1, 2, 2])).tolist() == [2]
    np.testing.assert_allclose(np.sort(found.weight[0])[-3:], np.array([0.5, 0.9, 0.9]) / 2.3)
    # within 1 only the first two: 0.9 against 0.5
    assert carried([0.9], "vote", radius=1.0).labels(np.array([1, 2, 2])).tolist() == [1]


def test_radius_includes_its_border_and_nothing_beyond():
    found = carried([2.1, 2.2], "vote", radius=2.1 - 2)
    assert found.labels(LABELS).tolist() == [3, 0]
    assert found.features(np.eye(3))[1].tolist() == [0, 0, 0]


@pytest.mark.parametrize(("labels", "expected"), [([3, 1, 2], 1), ([0, 0, 2], 2), ([0, 0, 0], 0)])
def test_equal_votes_go_to_the_smaller_label_and_unlabelled_gaussians_have_none(labels, expected):
    found = carried([1.0], "vote", gaussians_of([0.5] * 3), radius=1.0)
    assert found.labels(np.array(labels)).tolist() == [expected]


def test_density_follows_the_falloff_of_a_gaussian():
    # scale 1 at x = 0.5 between 0 and 1, both at distance 0.5; the third at 1.5
    alpha = OPAQUE * np.exp(-np.array([0.25, 0.25, 2.25]) / 2)
    np.testing.assert_allclose(carried([0.5], "density").features(np.eye(3))[0], alpha / alpha.sum())
    far = carried([1e4], "density", gaussians_of(scales=(0.01, 0.01, 0.01)))
    assert far.labels(LABELS).tolist() == [3]  # relative weights are used far from all Gaussians


@pytest.mark.parametrize("length", [1, 7])
def test_density_turns_with_the_gaussian(length):
    # Two at the origin, long along x, turned about z by the angle of a triangle with sides 3, 4 and 5, and
    # back. The point is 2 away at that angle: one standard deviation of the first.
    quats = length * np.array([[2, 0, 0, 1], [2, 0, 0, -1]])
    turned = gaussians_of([0.5] * 2, np.zeros((2, 3)), (2.0, 0.5, 1), quats)
    found = carried_to(2 * np.array([[3 / 5, 4 / 5, 0]]), turned, "density", 0.0)
    # In the frame of the second, it is at twice the angle: (2 * -7/25 / 2)**2 + (2 * 24/25 / 0.5)**2
    alpha = np.exp([-1 / 2, -((7 / 25) ** 2 + 3.84**2) / 2])
    np.testing.assert_allclose(found.features(np.eye(2))[0], alpha / alpha.sum())


coordinates = st.lists(st.tuples(*[st.integers(-5, 5)] * 3), min_size=1, max_size=12)


@settings(max_examples=25, deadline=None)
@given(coordinates, coordinates)
def test_weights_are_shares_and_threads_change_nothing(points, means):
    gaussians = gaussians_of(np.linspace(0.2, 0.9, len(means)), np.array(means, float), (0.7, 0.7, 0.7))
    one, two = (carried_to(np.array(points, float), gaussians, "density", 0.0, threads) for threads in (1, 2))
    assert (one.weight >= 0).all()
    np.testing.assert_allclose(one.weight.sum(axis=1), 1)
    np.testing.assert_array_equal(two.index, one.index)
    np.testing.assert_array_equal(two.weight, one.weight)


@settings(max_examples=25, deadline=None)
@given(coordinates, st.randoms(use_true_random=False))
def test_order_of_points_does_not_matter(points, random):
    points = np.array(points, float)
    order = random.sample(range(len(points)), len(points))
    found, other = (carried_to(each, gaussians_of(), "vote", 3.0) for each in (points, points[order]))
    np.testing.assert_array_equal(found.labels(LABELS)[order], other.labels(LABELS))


def test_classes_follow_the_cosine_whatever_the_length_and_the_first_wins_ties():
    texts = np.array([[1.0, 0], [0, 1]])
    features = np.array([[0.1, 0.2], [30.0, 20.0], [0.0, 0.0], [0.5, 0.5], [-0.3, -0.1]])
    assert classify(features, texts).tolist() == [2, 1, 0, 1, 2]
    assert classify(np.zeros((0, 2)), texts).shape == (0,)
