"""Queries of a view, their scores, and the scores of missing answers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.hierarchy import AnnotatedNode, HierarchyAnnotations, write_hierarchy
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.protocols.answers import PackedMasks, Selections
from hilsplat.evaluate.protocols.cards import card_of
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.protocols.views import measure_view
from hilsplat.settings import EvaluateSettings
from tests.unit.evaluate.builders import box, region_of

SIZE = (10, 10)


def annotations_of(folder, nodes, regions):
    """Annotations of one view from (text, level, parent) and half-open (rows, columns)."""
    labels = {level: np.full(SIZE, -1, np.int32) for level in LEVELS}
    for node, ((_, level, _), (rows, columns)) in enumerate(zip(nodes, regions, strict=True)):
        labels[Level(level)][slice(*rows), slice(*columns)] = node
    records = [AnnotatedNode(node, level, parent, text) for node, (text, level, parent) in enumerate(nodes)]
    write_hierarchy(folder, records, {"v.png": labels}, {"v.png": range(len(nodes))})
    return HierarchyAnnotations.load(folder)


def truth_in(annotations, min_px=1):
    """Truth whose minimum area is not in protocol names."""
    return replace(ViewTruth.of(annotations, "v.png", SIZE, min_px), min_px=0)


def truth_of(folder, nodes, regions):
    return truth_in(annotations_of(folder, nodes, regions))


class HandMade:
    """Given answers: nodes, rows of `masks`, by text or path and level; relevancy maps by text.

    `scene_wide` contains those answers that differ if the whole scene is searched.
    """

    def __init__(self, masks, answers, relevancy=None):
        self.masks, self.answers, self.maps, self.scene_wide = masks, answers, relevancy or {}, {}
        self.views, self.field = self, self

    def relevancy(self, texts, view):
        return np.stack([self.maps.get(text, np.zeros((3, *SIZE), np.float32)) for text in texts])

    def cosine(self, texts, view, pixels):
        return self.relevancy(texts, view).reshape(len(texts), 3, -1)[..., pixels]

    node_relevancy_map, node_cosine = relevancy, cosine

    def select(self, path, *, level=None, view=None):
        answers = self.answers if view == "v.png" else self.answers | self.scene_wide
        found = answers.get(path, answers.get((path[0], level), []) if len(path) == 1 else [])
        return SimpleNamespace(ids=np.array(found, dtype=np.int64), level=level)

    def node_masks(self, view, ids):
        return np.any([self.masks[node] for node in ids], axis=0)


def measured(scene, truth, flat=(), **settings):
    """{(method, protocol, query, level, metric): value} of one view."""
    section = EvaluateSettings(min_region_px=1, **settings)
    rows = measure_view(Selections(scene), truth, "v.png", PackedMasks(SIZE), section, ExtraProtocols(flat))
    return {(row.method, row.protocol, row.query, row.level, row.metric): row.value for row in rows}


# the worked example of hierarchical consistency: A holds a1 and half of a2, B holds b1, a1 holds x
NODES = [("A", 1, -1), ("B", 1, -1), ("a1", 2, 0), ("a2", 2, 0), ("b1", 2, 1), ("x", 3, 2)]
REGIONS = [
    ((0, 10), (0, 5)),
    ((0, 5), (5, 10)),
    ((0, 4), (0, 5)),
    ((4, 8), (3, 5)),
    ((0, 2), (5, 10)),
    ((0, 2), (0, 2)),
]
ANSWERED = [*REGIONS[:3], ((4, 8), (3, 7)), *REGIONS[4:]]


def worked_example(tmp_path, without=()):
    annotations = annotations_of(tmp_path, NODES, REGIONS)
    answers = {}
    for node, (text, level, _) in enumerate(NODES):
        if text not in without:
            answers[text, Level(level)] = answers[text, None] = [node]
            answers[annotations.path_of(node)] = [node]
    scene = HandMade([box(*each) for each in ANSWERED], answers)
    return scene, truth_in(annotations)


def test_consistency_rows_match_the_worked_example(tmp_path):
    scene, truth = worked_example(tmp_path)
    values = measured(scene, truth, methods=("tree", "tree-path"))
    for protocol in ("level-given@6", "level-auto@7", "scene-wide@2", "path@4"):
        key = ("tree-path" if "path" in protocol else "tree", f"hierarchy/{protocol}", "", "")
        assert values[*key, "hc_containment"] == pytest.approx(0.9375)
        assert values[*key, "hc_literal"] == pytest.approx(0.27)
    # the annotations nest perfectly: a2 is 8 px of A, so literal is ((20 + 8)/50/2 + 10/25)/2 = 0.34
    reference = ("truth", "hierarchy/annotations@1", "", "")
    assert values[*reference, "hc_containment"] == 1
    assert values[*reference, "hc_literal"] == pytest.approx((0.34 + 0.2) / 2)


def test_missing_answer_counts_zero_and_breaks_consistency(tmp_path):
    scene, truth = worked_example(tmp_path, without=("x",))
    values = measured(scene, truth, methods=("tree",))
    given = ("tree", "hierarchy/level-given@6")
    assert values[*given, "x", "subpart", "iou"] == 0
    assert values[*given, "A", "whole", "iou"] == 1
    assert values[*given, "", "", "hc_containment"] == pytest.approx(0.4375)


def test_scene_wide_answers_do_not_depend_on_the_view(tmp_path):
    scene, truth = worked_example(tmp_path)
    scene.scene_wide = {("x", Level.SUBPART): [4], ("A", "a1", "x"): [4]}  # b1 is more like it, elsewhere
    values = measured(scene, truth, methods=("tree", "tree-path"))
    assert values["tree-path", "hierarchy/path@4", "x", "subpart", "iou"] == 1
    assert values["tree", "hierarchy/level-given@6", "x", "subpart", "iou"] == 1
    assert values["tree", "hierarchy/scene-wide@2", "x", "subpart", "iou"] == 0
    assert values["tree", "hierarchy/scene-wide@2", "A", "whole", "iou"] == 1
    # as if x had no answer: no pixel of its mask lies inside a1
    assert values["tree", "hierarchy/scene-wide@2", "", "", "hc_containment"] == pytest.approx(0.4375)


def test_regions_with_the_same_text_are_merged(tmp_path):
    nodes = [("cup", 1, -1), ("cup", 1, -1)]
    truth = truth_of(tmp_path, nodes, [((0, 4), (0, 4)), ((6, 10), (6, 10))])
    scene = HandMade([box((0, 4), (0, 4))], {("cup", Level.WHOLE): [0], ("cup", None): [0]})
    values = measured(scene, truth, methods=("tree",))
    assert values["tree", "hierarchy/level-given@6", "cup", "whole", "iou"] == pytest.approx(0.5)
    assert not [key for key in values if key[4].startswith("hc_")]  # a view without parents


def test_text_at_two_levels_is_one_category_and_two_queries(tmp_path):
    nodes = [("wheel", 1, -1), ("cart", 1, -1), ("wheel", 2, 1)]
    truth = truth_of(tmp_path, nodes, [((0, 2), (0, 10)), ((4, 10), (0, 10)), ((8, 10), (0, 5))])
    queries = [(query.text, int(query.level)) for query in truth.queries]
    assert queries == [("wheel", 1), ("cart", 1), ("wheel", 2)]
    assert [query.truth.sum() for query in truth.categories] == [20 + 10, 60]


def test_small_regions_are_not_scored_and_labels_of_another_size_are_refused(tmp_path):
    annotations = annotations_of(tmp_path, NODES, REGIONS)
    truth = truth_in(annotations, 9)
    assert [query.text for query in truth.queries] == ["A", "B", "a1", "b1"]  # x has 4 px, a2 has 8
    assert truth.families() == [[(("A",), [("A", "a1")]), (("B",), [("B", "b1")])], []]
    with pytest.raises(MisalignedArtifactError, match=r"10 x 10"):
        ViewTruth.of(annotations, "v.png", (20, 20), 1)


def test_automatic_level_of_the_field_follows_the_highest_value(tmp_path):
    truth = truth_of(tmp_path, [("cup", 1, -1)], [((2, 6), (2, 6))])
    relevancy = np.full((3, *SIZE), 0.4, np.float32)
    relevancy[0, 2:6, 2:6] = 0.8  # right place, at the level of the annotation
    relevancy[2, 8, 8] = 0.9  # wrong place, finest level, higher
    scene = HandMade([], {}, {"cup": relevancy})
    values = measured(scene, truth, methods=("field",), filter_px=1, majority=False)
    given, auto, lerf = (
        f"{name} (filter 1, no majority)"
        for name in ("hierarchy/level-given@6", "hierarchy/level-auto@7", "lerf/langsplat@3")
    )
    for metric in ("iou", "localization_box"):
        assert values["field", given, "cup", "whole", metric] == 1
        assert values["field", auto, "cup", "whole", metric] == 0
        assert values["field", lerf, "cup", "", metric] == 0
    assert values["field", given, "cup", "whole", "best_threshold_iou"] == 1


def test_a_relevancy_that_is_not_a_number_is_an_error():
    relevancy = np.full((3, *SIZE), 0.1, np.float32)
    relevancy[1, 2, 3] = np.nan
    truth = ViewTruth.of_regions([region_of(box((2, 6), (2, 6)), "cup")], SIZE)
    with pytest.raises(ArtifactError, match=r"relevancy of view v\.png is NaN at 1 pixels"):
        measured(HandMade([], {}, {"cup": relevancy}), truth, methods=("field",))


@pytest.mark.parametrize("constant", [0.0, 0.3])
def test_an_answer_with_nothing_in_it_localizes_nothing(tmp_path, constant):
    truth = truth_of(tmp_path, [("bear", 1, -1), ("nose", 2, 0)], [((0, 10), (0, 5)), ((2, 4), (2, 4))])
    scene = HandMade([], {}, dict.fromkeys(("bear", "nose"), np.full((3, *SIZE), constant, np.float32)))
    values = measured(scene, truth, methods=("field", "tree", "tree-path"))
    found = {key: value for key, value in values.items() if key[-1].startswith("localization")}
    assert {key[0] for key in found} == {"field", "tree", "tree-path"}
    assert set(found.values()) == {0.0}


def test_a_repeated_text_nests_in_each_of_its_wholes(tmp_path):
    nodes = [("chair", 1, -1), ("table", 1, -1), ("leg", 2, 0), ("leg", 2, 1)]
    regions = [((0, 10), (0, 5)), ((0, 10), (5, 10)), ((8, 10), (0, 5)), ((8, 10), (5, 10))]
    truth = truth_of(tmp_path, nodes, regions)
    answers = {("chair", None): [0], ("table", None): [1], ("leg", None): [2, 3]}
    answers |= {("chair", Level.WHOLE): [0], ("table", Level.WHOLE): [1], ("leg", Level.PART): [2, 3]}
    values = measured(HandMade([box(*each) for each in regions], answers), truth, methods=("tree",))
    perfect = values["truth", "hierarchy/annotations@1", "", "", "hc_containment"]
    assert values["tree", "hierarchy/level-given@6", "", "", "hc_containment"] == perfect == 0.5
    assert values["tree", "hierarchy/level-given@6", "", "", "hc_anchored"] == 0.5


def test_path_localization_searches_the_parent(tmp_path):
    nodes = [("bear", 1, -1), ("nose", 2, 0)]
    regions = [((0, 10), (0, 5)), ((2, 4), (2, 4))]
    truth = truth_of(tmp_path, nodes, regions)
    relevancy = np.full((3, *SIZE), 0.4, np.float32)
    relevancy[1, 2:4, 2:4], relevancy[1, 7, 8] = 0.7, 0.9  # the nose, and something beside the bear
    answers = {("bear",): [0], ("bear", "nose"): [1], ("nose", Level.PART): [1]}
    scene = HandMade([box(*each) for each in regions], answers, {"nose": relevancy})
    values = measured(scene, truth, methods=("tree", "tree-path"), filter_px=1)
    assert values["tree", "hierarchy/level-given@6 (filter 1)", "nose", "part", "localization_box"] == 0
    assert values["tree-path", "hierarchy/path@4 (filter 1)", "nose", "part", "localization_box"] == 1


def test_perfect_tree_of_the_block_world_scores_one(block_world):
    view, size_hw, settings = "001.png", (64, 64), EvaluateSettings()
    truth = ViewTruth.of(block_world.annotations, view, size_hw, settings.min_region_px)
    selections = Selections(block_world.answers)
    rows = list(measure_view(selections, truth, view, PackedMasks(size_hw), settings, ExtraProtocols()))
    given = [row for row in rows if row.method == "tree" and row.protocol == "hierarchy/level-given@6"]
    ious = {row.query: row.value for row in given if row.metric == "iou"}
    assert ious == dict.fromkeys(("bear", "chest", "head", "lid", "nose"), 1.0)
    assert {row.value for row in given if row.metric in ("localization_box", "hc_containment")} == {1.0}
    for name in {row.protocol for row in rows}:
        assert {row.metric for row in rows if row.protocol == name} == set(card_of(name).metrics)
    key = ("field", "hierarchy/level-given@6", "iou", "bear")
    (value,) = [row.value for row in rows if (row.method, row.protocol, row.metric, row.query) == key]
    assert value > 0.9  # exact features; the filter rounds the corners
