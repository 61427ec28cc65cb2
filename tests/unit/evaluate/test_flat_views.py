"""3D-OVS and LERF-Mask beside LangSplat's protocol: what is asked, compared and named."""

import numpy as np
import pytest

from hilsplat.base.levels import Level
from hilsplat.evaluate.protocols.answers import ViewMaps
from hilsplat.evaluate.protocols.cards import LERF_MASK, OVS_ARGMAX, card_named
from hilsplat.evaluate.protocols.flat_views import FlatProtocols, eighth
from hilsplat.evaluate.protocols.view_truth import Query

SIZE = (16, 32)


def unasked(texts):
    raise AssertionError(f"maps of {texts} were not to be asked for")


NO_MORE = ViewMaps(unasked)


def region(columns):
    mask = np.zeros(SIZE, dtype=bool)
    mask[:, slice(*columns)] = True
    return mask


def query(text, columns, level=Level.WHOLE):
    return Query(text, level, ((text,),), region(columns), np.array([[columns[0], 0, columns[1] - 1, 15]]))


def maps(columns, value=0.9):
    found = np.full((3, *SIZE), 0.1, np.float32)
    found[1][region(columns)] = value
    return found


def test_an_eighth_takes_one_pixel_of_each_block():
    picture = np.arange(16 * 32, dtype=np.float32).reshape(SIZE)
    assert eighth(picture).shape == (2, 4)
    assert set(eighth(picture).ravel()) <= set(picture.ravel())


def test_argmax_compares_labelled_pixels_of_a_stand_in_alone():
    # cup: columns 0 to 15, plate: 16 to 23; the rest has no text. The plate's map is right, the cup's is
    # right on its left half, and the plate wins on the right half.
    cup, plate = query("cup", (0, 16)), query("plate", (16, 24))
    flat = FlatProtocols([OVS_ARGMAX], Level.WHOLE)
    assert list(flat.add("field", maps((0, 8)), None, cup, [cup], NO_MORE)) == []
    assert (
        list(flat.add("field", np.maximum(maps((16, 24)), maps((8, 16), 0.5)), None, plate, [plate], NO_MORE))
        == []
    )
    rows = {(row.metric, row.query): row for row in flat.finish()}
    # an eighth: cup has columns 0, 1, plate column 2; predicted cup: 0, plate: 1, 2
    assert rows["iou", "cup"].value == 0.5
    assert rows["iou", "plate"].value == 0.5
    assert rows["pixel_accuracy", ""].value == pytest.approx(2 / 3)
    assert rows["iou", "cup"].protocol == "3d-ovs/argmax@1 (labelled pixels, best level, wholes)"


def test_without_levels_every_pixel_is_compared():
    cup = query("cup", (0, 16), level=None)
    flat = FlatProtocols([OVS_ARGMAX], None)
    list(flat.add("tree", maps((0, 16)), None, cup, [], NO_MORE))
    rows = {row.metric: row for row in flat.finish()}
    assert rows["pixel_accuracy"].value == 0.5  # the only text wins everywhere
    assert rows["iou"].protocol == "3d-ovs/argmax@1 (best level)"


def test_parts_are_not_asked_on_a_stand_in():
    handle = query("handle", (0, 4), level=Level.PART)
    flat = FlatProtocols([LERF_MASK, OVS_ARGMAX], Level.WHOLE)
    assert list(flat.add("field", maps((0, 4)), None, handle, [handle], NO_MORE)) == []
    assert list(flat.finish()) == []


def test_lerf_mask_takes_the_trees_own_answer_and_the_fields_mask():
    cup = query("cup", (0, 16))
    flat = FlatProtocols([LERF_MASK], Level.WHOLE)
    tree = list(flat.add("tree", maps((0, 16)), region((0, 8)), cup, [cup], NO_MORE))
    field = list(flat.add("field", maps((0, 16)), None, cup, [cup], NO_MORE))
    assert {row.metric: row.value for row in tree}["iou"] == 0.5
    assert {row.metric: row.value for row in field}["iou"] > 0.9
    assert {row.protocol for row in tree + field} == {"lerf-mask/gaussian-grouping@1 (wholes)"}


def test_rules_of_3d_ovs_are_applied_to_the_maps_of_either_method():
    cup = query("cup", (0, 16))
    flat = FlatProtocols([card_named("3d-ovs/langsplat")], Level.WHOLE, ["relevancy scale 5"])
    for method in ("field", "tree"):
        rows = list(flat.add(method, maps((0, 16)), None, cup, [cup], NO_MORE))
        assert {row.metric: row.value for row in rows} == {"iou": 1.0, "boundary_iou": 1.0}
        assert {row.protocol for row in rows} == {"3d-ovs/langsplat@1 (wholes, relevancy scale 5)"}
