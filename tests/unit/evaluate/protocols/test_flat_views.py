"""Protocols for images without levels: 3D-OVS by argmax and by the rule of LangSplatV2, and LERF-Mask."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilsplat.base.images import write_png
from hilsplat.base.levels import Level
from hilsplat.datasets.images.ovs3d import FOREGROUND
from hilsplat.datasets.labelled import mask_region
from hilsplat.evaluate.metrics.relevancy_rule import SmoothedRelevancy, relevancy_mask, smoothing_of
from hilsplat.evaluate.protocols.cards import LERF_MASK, OVS_ARGMAX, OVS_NODES, card_of
from hilsplat.evaluate.protocols.flat_views import FlatProtocols
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.query.relevancy import relevancy_of_margins
from tests.unit.evaluate.builders import box, region_of

SIZE = (16, 32)


def region(columns):
    return box((0, SIZE[0]), columns, SIZE)


def query(text, columns, level=Level.WHOLE):
    """A text whose region is a range of columns."""
    mask = region(columns)
    truth = ViewTruth.of_regions([region_of(mask, text)], SIZE)
    (found,) = truth.categories or truth.absent
    return replace(found, level=level)


def maps(columns, value=0.9):
    found = np.full((3, *SIZE), 0.1, np.float32)
    found[1][region(columns)] = value
    return found


def flat_of(cards, level=Level.WHOLE, **cosines):
    """The protocols in a scene whose cosines with texts are given as maps (3, H, W)."""

    def cosine(texts, view, pixels):
        return np.stack([cosines[text].reshape(3, -1)[:, pixels] for text in texts])

    scene = SimpleNamespace(field=SimpleNamespace(cosine=cosine))
    return FlatProtocols(scene, "v.png", cards, level)


def added(flat, found, text, method="field", nodes_mask=None):
    """Rows of a text, labelled at its own level, whose relevancy is given."""
    return list(flat.add(method, found, smoothing_of(found), nodes_mask, text, [text]))


def test_argmax_compares_labelled_pixels_of_a_stand_in_alone():
    # cup: columns 0 to 15, plate: 16 to 23; the rest has no text. The plate's map is right, the cup's is
    # right on its left half, and the plate wins on the right half.
    cup, plate = query("cup", (0, 16)), query("plate", (16, 24))
    flat = flat_of([OVS_ARGMAX], cup=maps((0, 8)), plate=np.maximum(maps((16, 24)), maps((8, 16), 0.5)))
    for each in (plate, cup):
        assert added(flat, maps((0, 1)), each) == []
    rows = {(row.metric, row.query): row for row in flat.finish()}
    # an eighth: cup has columns 0, 1, plate column 2; predicted cup: 0, plate: 1, 2
    assert rows["iou", "cup"].value == 0.5
    assert rows["iou", "plate"].value == 0.5
    assert rows["pixel_accuracy", ""].value == pytest.approx(2 / 3)
    assert rows["iou", "cup"].protocol == "3d-ovs/argmax@3 (labelled pixels, best level, wholes)"


def test_canonical_phrases_do_not_choose_the_level():
    # Cosines with one and two are (0.30, 0.20) at the whole and (0.22, 0.26) at the part; the nearest
    # canonical phrase has 0.28 and 0.18 there, so that the highest relevancy is that of two at the part.
    one, two = query("one", (0, 32), None), query("two", (0, 0), None)
    cosine = {text: np.full((3, *SIZE), -np.inf, np.float32) for text in ("one", "two")}
    for level, values in enumerate(((0.30, 0.20), (0.22, 0.26))):
        for text, value in zip(cosine, values, strict=True):
            cosine[text][level] = value
    generic = np.array([0.28, 0.18, 0.0], np.float32)[:, None, None]
    relevancy = {text: relevancy_of_margins(values - generic, 10.0) for text, values in cosine.items()}
    assert relevancy["two"].max() > relevancy["one"].max()
    flat = flat_of([OVS_ARGMAX], None, **cosine)
    for each in (one, two):
        added(flat, relevancy[each.text], each)
    rows = {(row.metric, row.query): row.value for row in flat.finish()}
    assert rows == {("iou", "one"): 1.0, ("iou", "two"): 0.0, ("pixel_accuracy", ""): 1.0}


def test_a_text_that_the_view_lacks_competes_and_counts_zero():
    cup, fork = query("cup", (0, 16), level=None), query("fork", (0, 0), level=None)
    cosines = {"cup": maps((0, 16)), "fork": maps((8, 32), 0.95)}
    flat = flat_of([OVS_ARGMAX, card_of("3d-ovs/langsplat")], None, **cosines)
    assert {row.query for row in added(flat, maps((0, 16)), cup)} == {"cup"}
    assert not added(flat, maps((8, 32)), fork)
    rows = {(row.metric, row.query): row for row in flat.finish()}
    values = {key: row.value for key, row in rows.items()}
    assert values == {("iou", "cup"): 0.5, ("iou", "fork"): 0.0, ("pixel_accuracy", ""): 0.25}
    assert rows["iou", "cup"].protocol == "3d-ovs/argmax@3 (best level)"  # every pixel is compared


def test_a_pixel_that_no_level_answers_is_a_miss():
    found = np.full((3, *SIZE), -np.inf, np.float32)
    found[1, :, 8:] = 0.2
    flat = flat_of([OVS_ARGMAX], None, cup=found)
    added(flat, found, query("cup", (0, 32), level=None))
    assert {row.metric: row.value for row in flat.finish()} == {"iou": 0.75, "pixel_accuracy": 0.75}


@pytest.mark.parametrize(
    ("text", "level", "cards"),
    [
        ("handle", Level.PART, [LERF_MASK, OVS_ARGMAX]),  # parts are not queried on a stand-in
        ("cup", Level.WHOLE, [card_of("lerf/opengaussian"), card_of("lerf/tree-nodes")]),  # no map rule
    ],
)
def test_parts_of_a_stand_in_and_protocols_without_a_map_rule_have_no_rows(text, level, cards):
    flat = flat_of(cards)
    assert added(flat, maps((0, 4)), query(text, (0, 4), level)) == []
    assert list(flat.finish()) == []


@pytest.mark.parametrize("card", [LERF_MASK, OVS_NODES])
def test_a_tree_answers_with_its_own_nodes_and_a_field_with_its_mask_or_not_at_all(card):
    cup, flat = query("cup", (0, 16)), flat_of([card])
    tree = added(flat, maps((0, 16)), cup, "tree", region((0, 8)))
    field = added(flat, maps((0, 16)), cup)
    assert {row.metric: row.value for row in tree}["iou"] == 0.5
    assert [row.value > 0.9 for row in field if row.metric == "iou"] == [True] * (card is LERF_MASK)
    assert {row.protocol for row in tree + field} == {f"{card.full_name} (wholes)"}


LANGSPLAT_V2 = card_of("3d-ovs/langsplat-v2")
RULE = LANGSPLAT_V2.rule


def window_means(values, reach):
    """Mean over the part of a square window that lies in the image, pixel by pixel."""
    height, width = values.shape
    out = np.empty((height, width))
    for i in range(height):
        for j in range(width):
            rows = slice(max(0, i - reach), i + reach + 1)
            out[i, j] = values[rows, max(0, j - reach) : j + reach + 1].mean()
    return out


def by_the_released_rule(coarse_to_fine, united=None):
    """Mask; LangSplatV2 stacks its levels from fine to coarse and never takes the finest."""

    def in_range(values):
        shifted = values - values.min()
        return np.clip(2 * shifted / (shifted.max() + 1e-9) - 1, 0, 1) > 0.25

    masks, scores = [], [0.0]
    for level in (Level.SUBPART, Level.PART, Level.WHOLE):
        raw = coarse_to_fine[level.index].astype(np.float64)
        mixed = 0.5 * (window_means(raw, 14) + raw)
        mask = in_range(mixed)
        if united is not None:
            mask |= in_range(united[level.index])
        masks.append(window_means(mask.astype(float), 3) > 0.5)
        if level is not Level.SUBPART:
            with np.errstate(invalid="ignore"):
                scores.append((mixed * masks[-1]).sum() / np.float64(masks[-1].sum()))
    return masks[int(np.argmax(scores))]  # NaN is the largest, as in torch


def blobs(rng, size_hw):
    """Maps with a plateau of random place, size and height, some too small to survive the smoothing."""
    maps = rng.uniform(0.3, 0.35, (3, *size_hw)).astype(np.float32)
    for each in maps:
        rows, columns = (sorted(rng.integers(0, side + 1, 2)) for side in size_hw)
        each[slice(*rows), slice(*columns)] += rng.uniform(0.05, 0.4)
        if rng.random() < 0.3:
            each[:] = 0.4
            each[tuple(rng.integers(0, side) for side in size_hw)] = 0.9
    return maps


@pytest.mark.parametrize("seed", range(12))
def test_masks_are_those_of_the_released_rule(seed):
    rng = np.random.default_rng(seed)
    maps = blobs(rng, (24, 31))
    united = blobs(rng, (24, 31)) if seed % 2 else None
    mask = relevancy_mask(SmoothedRelevancy.of(maps, RULE), None, RULE, united)
    np.testing.assert_array_equal(mask, by_the_released_rule(maps, united))


@pytest.mark.parametrize(
    ("text", "others", "score"), [("wood wall", ["wood table"], 1), ("rabbit", [], 2 / 3)]
)
def test_wood_wall_alone_is_united_with_wood_table_and_any_grey_is_true(tmp_path, text, others, score):
    grey = np.zeros((40, 40), np.uint8)  # the upper half of the label is 255 and its third quarter grey
    grey[:20], grey[20:30] = 255, 1
    path = tmp_path / f"{text}.png"
    write_png(path, grey)
    label = mask_region(path, FOREGROUND, grey.shape, [], min_grey=1)
    (query,) = ViewTruth.of_regions([label], grey.shape).categories
    asked = []

    def high_in(rows):
        return np.where(box(rows, (0, 40), (40, 40)), 0.9, 0.1).astype(np.float32)[None].repeat(3, axis=0)

    def relevancy(texts, _):
        asked.extend(texts)
        return high_in((20, 30))[None]

    scene = SimpleNamespace(field=SimpleNamespace(relevancy=relevancy))
    flat = FlatProtocols(scene, "v.png", [LANGSPLAT_V2, card_of("3d-ovs/langsplat")], None)
    rows = added(flat, high_in((0, 20)), query)
    found = {row.protocol.partition("@")[0]: row.value for row in rows if row.metric == "iou"}
    assert asked == others
    assert found == {"3d-ovs/langsplat-v2": pytest.approx(score), "3d-ovs/langsplat": 1.0}
