"""3D-OVS by LangSplatV2's rule, compared with a second implementation and case by case."""

import numpy as np
import pytest

from hilsplat.base.images import write_png
from hilsplat.base.levels import Level
from hilsplat.datasets.images.ovs3d import FOREGROUND
from hilsplat.datasets.labelled import LabelledRegion, read_mask_file
from hilsplat.evaluate.metrics.relevancy_rule import SmoothedRelevancy, relevancy_mask
from hilsplat.evaluate.protocols.answers import ViewMaps
from hilsplat.evaluate.protocols.cards import OVS_LANGSPLAT_V2, card_named
from hilsplat.evaluate.protocols.flat_views import FlatProtocols
from hilsplat.evaluate.protocols.view_truth import ViewTruth

RULE = OVS_LANGSPLAT_V2.rule


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
    """Mask and level; LangSplatV2 stacks its levels from fine to coarse and never takes the finest."""

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
    chosen = int(np.argmax(scores))  # NaN is the largest, as in torch
    return masks[chosen], (Level.SUBPART, Level.PART, Level.WHOLE)[chosen]


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
def test_masks_and_levels_are_those_of_the_released_rule(seed):
    rng = np.random.default_rng(seed)
    maps = blobs(rng, (24, 31))
    united = blobs(rng, (24, 31)) if seed % 2 else None
    mask, level = relevancy_mask(SmoothedRelevancy.of(maps, RULE), None, RULE, united)
    expected, expected_level = by_the_released_rule(maps, united)
    np.testing.assert_array_equal(mask, expected)
    assert level is expected_level


def test_an_empty_mask_wins_the_level():
    maps = np.full((3, 40, 40), 0.1, np.float32)
    maps[Level.WHOLE.index, :20] = 0.9
    maps[Level.PART.index, 20, 20] = 0.9  # one pixel, which the majority filter removes
    mask, level = relevancy_mask(SmoothedRelevancy.of(maps, RULE), None, RULE)
    assert level is Level.PART
    assert not mask.any()


def halves(rows):
    maps = np.full((3, 40, 40), 0.1, np.float32)
    maps[:, slice(*rows)] = 0.9
    return maps


@pytest.mark.parametrize(
    ("text", "others", "score"), [("wood wall", ["wood table"], 1), ("rabbit", [], 2 / 3)]
)
def test_wood_wall_alone_is_united_with_wood_table_and_any_grey_is_true(tmp_path, text, others, score):
    grey = np.zeros((40, 40), np.uint8)  # the upper half of the label is 255 and its third quarter grey
    grey[:20], grey[20:30] = 255, 1
    path = tmp_path / "label.png"
    write_png(path, grey)
    region = LabelledRegion(
        text,
        grey.shape,
        lambda: read_mask_file(path, FOREGROUND),
        path=(text,),
        any_grey=lambda: read_mask_file(path, 1),
    )
    (query,) = ViewTruth.of_regions([region], grey.shape).categories
    asked = []

    def more(texts, *_):
        asked.extend(texts)
        return halves((20, 30))[None]

    flat = FlatProtocols([OVS_LANGSPLAT_V2, card_named("3d-ovs/langsplat")], None)
    rows = list(flat.add("field", halves((0, 20)), None, query, [], ViewMaps(more, more)))
    found = {row.protocol.partition("@")[0]: row.value for row in rows if row.metric == "iou"}
    assert asked == others
    assert found == {"3d-ovs/langsplat-v2": pytest.approx(score), "3d-ovs/langsplat": 1.0}
