"""Digests of masks, and artifacts refused because of them."""

import numpy as np
import pytest

from hilsplat.base.artifacts import write_index
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.segment.digests import digest_of, digests_in, index_entry, load_masks, require_same_masks
from hilsplat.segment.masks import HierarchicalMasks
from tests.unit.segment.handmade import pack


def two_masks() -> HierarchicalMasks:
    """A mask of the left column and one of the top row."""
    dense = np.zeros((2, 3, 4), bool)
    dense[0, :, 0] = dense[1, 0] = True
    return pack(dense, [1, 2], [0.9, 0.8])


def test_a_digest_depends_on_order_size_pixels_levels_and_scores(tmp_path):
    masks = two_masks()
    pixels = masks.dense()
    pixels[0, 2, 3] = True
    others = (
        masks.take(np.array([1, 0])),
        masks.take(np.array([0])),
        pack(masks.dense().reshape(2, 4, 3), [1, 2], [0.9, 0.8]),
        pack(pixels, [1, 2], [0.9, 0.8]),
        pack(masks.dense(), [1, 3], [0.9, 0.8]),
        pack(masks.dense(), [1, 2], [0.9, 0.7]),
        masks.take(np.zeros(0, np.int64)),
    )
    assert len({digest_of(each) for each in (masks, *others)}) == 8
    masks.save(tmp_path / "v.npz")
    assert digest_of(HierarchicalMasks.load(tmp_path / "v.npz")) == digest_of(two_masks()) == digest_of(masks)


def test_masks_that_differ_from_the_recorded_digest_are_refused(tmp_path):
    two_masks().take(np.array([1, 0])).save(tmp_path / "v.npz")
    write_index(tmp_path, {"v": index_entry(two_masks())})
    with pytest.raises(MisalignedArtifactError, match=r"index entry of view v was not made from .*v\.npz"):
        load_masks(tmp_path, "v", digests_in(tmp_path))
    with pytest.raises(MisalignedArtifactError, match=r"expected +nothing\n +found +digest"):
        load_masks(tmp_path, "v", {})


@pytest.mark.parametrize("entry", [{}, {"masks_sha256": 3}, [], None, 7])
def test_an_index_without_digests_is_refused(tmp_path, entry):
    write_index(tmp_path, {"v": entry})
    with pytest.raises(ArtifactError, match=r"a different version of hilsplat(.|\n)*found +none for view v"):
        digests_in(tmp_path)


@pytest.mark.parametrize("rows", [[1, 0], [0], None])
def test_the_error_names_the_view_that_differs_in_either_artifact(tmp_path, rows):
    same = {"u": index_entry(two_masks())}
    more = {} if rows is None else {"v": index_entry(two_masks().take(np.array(rows)))}
    write_index(tmp_path / "clip", {**same, **more})
    write_index(tmp_path / "masks", {**same, "v": index_entry(two_masks())})
    for one, other in (("clip", "masks"), ("masks", "clip")):
        words = rf"{one} was not made from the masks of view v in .*{other}"
        with pytest.raises(MisalignedArtifactError, match=words):
            require_same_masks(tmp_path / one, tmp_path / other)
    require_same_masks(tmp_path / "clip", tmp_path / "clip")
