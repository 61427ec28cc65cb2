"""Windows and their targets."""

import numpy as np
import pytest

from models.training.data import cut_window, nested_targets, region_centres
from tests.unit.training.drawn import drawn_views


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
        image, labels, (x0, y0, side) = cut_window(
            np.random.default_rng(seed), views.images[0], views.labels[0], 48
        )
        assert image.shape == (48, 48, 3)
        green = (image[..., 1] > 150) & (image[..., 0] < 80)
        assert (green == (labels[0] == 3)).mean() > 0.97  # edges are mixed where the window was resized
        assert x0 >= 0 and y0 >= 0 and max(x0, y0) + side <= 1
