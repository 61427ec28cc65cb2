"""Gaussians assigned to points, and the classes of features."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.evaluate.protocols.carry import classify, gaussians_of_points
from tests.unit.round_gaussians import round_gaussians

MEANS = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
OPAQUE = np.array([0.9, 0.5, 0.9])


def gaussians_of(opacities=OPAQUE, means=MEANS):
    """Gaussians with exact opacities, not rounded through their logits."""
    gaussians = round_gaussians(means)

    class Exact(type(gaussians)):
        pass

    Exact.opacities = np.array(opacities, float)
    return Exact(**vars(gaussians))


def carried(xs, mode, gaussians=None):
    """Assign Gaussians, by default the three on the x axis, to the points (x, 0, 0)."""
    points = np.array([[x, 0.0, 0.0] for x in xs])
    return gaussians_of_points(points, gaussians_of() if gaussians is None else gaussians, mode)


def test_frozen_gaussians_are_the_points_and_transparent_ones_are_not_scored():
    index, is_scored = carried([0, 1, 2], "frozen", gaussians_of([0.09, 0.1, 0.8]))
    assert index.tolist() == [0, 1, 2]
    assert is_scored.tolist() == [False, True, True]
    with pytest.raises(MisalignedArtifactError, match=r"expected  4 Gaussians, one per point"):
        carried([0, 1, 2, 3], "frozen")


def test_nearest_skips_transparent_gaussians():
    assert carried([0.9, 100], "nearest")[0].tolist() == [1, 2]
    index, is_scored = carried([0.9, 1.1], "nearest", gaussians_of([0.9, 0.05, 0.9]))
    assert index.tolist() == [0, 2]
    assert is_scored.all()
    with pytest.raises(MisalignedArtifactError, match=r"3 Gaussians, all below"):
        carried([0.0], "nearest", gaussians_of([0.01] * 3))


coordinates = st.lists(st.tuples(*[st.integers(-5, 5)] * 3), min_size=1, max_size=12)


@settings(max_examples=25, deadline=None)
@given(coordinates, coordinates)
def test_threads_change_nothing(points, means):
    gaussians = gaussians_of(np.linspace(0.2, 0.9, len(means)), np.array(means, float))
    placed = np.array(points, float)
    one, two = (gaussians_of_points(placed, gaussians, "nearest", threads)[0] for threads in (1, 2))
    np.testing.assert_array_equal(two, one)


def test_classes_follow_the_cosine_whatever_the_length_and_the_first_wins_ties():
    texts = np.array([[1.0, 0], [0, 1]])
    features = np.array([[0.1, 0.2], [30.0, 20.0], [0.0, 0.0], [0.5, 0.5], [-0.3, -0.1]])
    assert classify(features, texts).tolist() == [2, 1, 0, 1, 2]
    assert classify(np.zeros((0, 2)), texts).shape == (0,)
