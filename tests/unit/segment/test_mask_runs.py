"""Run-length encoded masks, compared with dense masks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hilsplat.base.errors import HilsplatError
from hilsplat.base.levels import Level
from hilsplat.segment.kernels import BAND_WORDS
from hilsplat.segment.masks import HierarchicalMasks, encode_runs, runs_of_labels
from tests.unit.segment.handmade import pack

shapes = st.tuples(st.integers(0, 6), st.integers(1, 5), st.integers(1, 5))
nonempty_masks = hnp.arrays(bool, shapes).filter(lambda masks: masks.any(axis=(1, 2)).all())


def test_runs_of_a_small_mask_by_hand():
    runs, offsets = encode_runs(np.array([[[0, 1, 1], [1, 0, 0]], [[1, 0, 0], [0, 0, 0]]], dtype=bool))
    assert runs.tolist() == [1, 3, 2, 0, 1, 5]
    assert offsets.tolist() == [0, 3, 6]


@given(nonempty_masks)
def test_pixels_overlaps_areas_and_boxes_are_those_of_dense_masks(dense):
    masks, flat = pack(dense), dense.reshape(len(dense), dense.shape[1] * dense.shape[2]).astype(int)
    np.testing.assert_array_equal(masks.dense(), dense)
    np.testing.assert_array_equal(masks.overlaps_px(), flat @ flat.T)
    np.testing.assert_array_equal(masks.area_px, flat.sum(axis=1))
    for mask, (x0, y0, x1, y1) in zip(dense, masks.box_xyxy, strict=True):
        ys, xs = np.nonzero(mask)
        assert (x0, y0, x1, y1) == (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1)


def test_overlaps_of_many_masks_are_counted_band_by_band_and_word_by_word():
    generator = np.random.default_rng(0)
    y, x = np.mgrid[:150, :200]
    circles = generator.uniform((0, 0, 2), (150, 200, 80), (250, 3))
    discs = [np.hypot(y - cy, x - cx) < radius for cy, cx, radius in circles]
    dense = np.stack([np.ones((150, 200), bool), *(disc for disc in discs if disc.any())])
    dense[1::3] &= generator.random(dense[1::3].shape) > 0.2
    assert len(dense) * 4 * 150 > BAND_WORDS  # more than one band of the packed masks, and more than one word
    flat = dense.reshape(len(dense), -1).astype(np.float64)
    np.testing.assert_array_equal(pack(dense).overlaps_px(), flat @ flat.T)


@given(nonempty_masks, st.data())
def test_a_window_equals_a_crop_of_the_mask(dense, data):
    masks = pack(dense)
    y0, y1 = sorted(data.draw(st.tuples(st.integers(0, dense.shape[1]), st.integers(0, dense.shape[1]))))
    x0, x1 = sorted(data.draw(st.tuples(st.integers(0, dense.shape[2]), st.integers(0, dense.shape[2]))))
    for row in range(len(dense)):
        np.testing.assert_array_equal(masks.window(row, (x0, y0, x1, y1)), dense[row, y0:y1, x0:x1])


@given(hnp.arrays(np.int32, st.tuples(st.integers(1, 5), st.integers(1, 6)), elements=st.integers(-1, 4)))
def test_runs_of_a_label_map_are_those_of_its_regions(labels):
    chosen = np.unique(labels[labels >= 0])
    expected = encode_runs(labels[None] == chosen[:, None, None])
    for found, other in zip(runs_of_labels(labels, chosen), expected, strict=True):
        np.testing.assert_array_equal(found, other)


def test_taken_and_joined_masks_keep_their_pixels():
    dense = np.random.default_rng(0).random((5, 4, 6)) > 0.5
    masks = pack(dense, [1, 2, 3, 1, 2])
    joined = HierarchicalMasks.concatenate([masks.take(np.array([3, 0])), masks.take(np.array([4]))])
    np.testing.assert_array_equal(joined.dense(), dense[[3, 0, 4]])
    assert joined.level.tolist() == [1, 1, 2]


def test_no_masks_at_all_is_a_valid_view():
    none = HierarchicalMasks.concatenate([pack(np.zeros((0, 3, 4)))] * 2)
    assert none.dense().shape == (0, 3, 4)
    assert (none.label_map(Level.WHOLE) == -1).all()
    assert none.overlaps_px().shape == (0, 0)


def test_empty_mask_is_refused():
    with pytest.raises(HilsplatError, match=r"masks \[1\] of 2"):
        pack(np.array([[[True]], [[False]]]))
