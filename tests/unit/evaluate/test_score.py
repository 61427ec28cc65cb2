"""`hilsplat.score`: arrays score like the same predictions in files and like the maps of our own scenes."""

import numpy as np
import pytest

import hilsplat
from hilsplat.base.errors import HilsplatError
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS
from hilsplat.datasets.classes import SCANNET200_INSTANCES, SCANNET_10
from hilsplat.datasets.labelled import LabelledScene
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.files_stage import run_evaluate_files
from hilsplat.evaluate.metrics.relevancy_rule import smoothing_of
from hilsplat.evaluate.protocols.answers import relevancy_of
from hilsplat.evaluate.protocols.cards import CARDS, card_of
from hilsplat.evaluate.protocols.flat_views import FlatProtocols
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.score import OF_THE_PIPELINE, SCORED
from hilsplat.evaluate.scores import read_scores
from tests.unit.evaluate.builders import box, region_of
from tests.unit.evaluate.conftest import NODES, TEXTS, region

SIZE = (32, 48)
IMAGES = [name for name, card in SCORED.items() if not card.classes and name != "hierarchy/level-given@6"]
POINTS = [name for name, card in SCORED.items() if card.classes and card.averaging == "scenes"]


def some_masks(seed: int, texts: tuple[str, ...]) -> dict[str, dict[str, np.ndarray]]:
    """Boxes of each text in two views."""
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 12, (2, len(texts), 2))
    return {
        view: {
            text: box((top, top + 15), (left, left + 20), SIZE)
            for text, (top, left) in zip(texts, rows, strict=True)
        }
        for view, rows in zip(("a.png", "b.png"), low, strict=True)
    }


def test_ious_are_averaged_by_hand():
    """A quarter and a half of two regions are found, and nothing of the third."""
    regions = {"cup": box((0, 8), (0, 8)), "mug": box((8, 10), (0, 10)), "pen": box((0, 2), (8, 10))}
    found, labels = {"v": {"cup": box((0, 4), (0, 4)), "mug": box((8, 9), (0, 10))}}, {"v": regions}
    scores = hilsplat.score(found, labels)
    assert scores.protocol == "lerf/langsplat@3 (masks of files)"
    assert scores.means["iou"] == pytest.approx((0.25 + 0.5 + 0) / 3)
    assert scores.means.keys() == {"iou", "boundary_iou"}
    ious = {row["query"]: row["value"] for row in scores.rows if row["metric"] == "iou"}
    assert ious == {"cup": 0.25, "mug": 0.5, "pen": 0.0}
    skipping = hilsplat.score(found, labels, "lerf-mask/gaussian-grouping-skipping")
    assert skipping.means["iou"] == pytest.approx((0.25 + 0.5) / 2)
    shares = hilsplat.score(found, labels, "lerf/opengaussian@1")
    assert shares.means["acc_25"] == pytest.approx(1 / 3)  # 0.25 is not above 0.25
    assert repr(scores).startswith("Scores(lerf/langsplat@3 (masks of files): iou")
    assert "\n" not in repr(scores)


@pytest.mark.parametrize("protocol", IMAGES)
def test_masks_score_like_the_same_masks_in_files(tmp_path, monkeypatch, protocol):
    texts = ("cup", "mug", "wood wall")
    labels, found = some_masks(0, texts), some_masks(1, texts)
    del found["a.png"]["mug"]
    regions = {view: tuple(region_of(m, text) for text, m in of.items()) for view, of in labels.items()}
    known, extra = LabelledScene("set", "s", {}, None, regions), ExtraProtocols((card_of(protocol),))
    monkeypatch.setattr(ExtraProtocols, "open", staticmethod(lambda name, data_root: ("set", known, extra)))
    for view, masks in found.items():
        for text, mask in masks.items():
            write_png(tmp_path / "theirs" / view.removesuffix(".png") / f"{text}.png", mask * np.uint8(255))
    run_evaluate_files(tmp_path / "theirs", tmp_path / "scores.csv", method="m", labels="set/s")
    frame = read_scores([tmp_path / "scores.csv"])
    frame = frame[frame["protocol"].str.startswith(protocol)].drop_duplicates(["view", "query", "metric"])
    scores = hilsplat.score(found, labels, protocol)
    assert set(frame["protocol"]) == {scores.protocol}
    expected = {(row.view, row.query, row.metric): row.value for row in frame.itertuples()}
    values = {(row["view"], row["query"], row["metric"]): row["value"] for row in scores.rows}
    assert values == {key: pytest.approx(value, abs=1e-6) for key, value in expected.items()}
    by_query = frame[frame["metric"] == "iou"].groupby("query")["value"].mean()
    is_by_class = card_of(protocol).averaging == "classes"
    mean = by_query.mean() if is_by_class else frame[frame["metric"] == "iou"]["value"].mean()
    assert scores.means["iou"] == pytest.approx(mean, abs=1e-6)


@pytest.mark.parametrize("protocol", ["3d-ovs/langsplat", "3d-ovs/langsplat-raw", "lerf/langsplat-v2"])
def test_relevancy_scores_like_that_of_our_own_scene(block_world, protocol):
    view, card = "001.png", card_of(protocol)
    truth = ViewTruth.of(block_world.annotations, view, (64, 64), 1)
    flat = FlatProtocols(block_world.answers, view, [card], None)
    expected = {}
    for category in truth.categories:
        (found,) = relevancy_of(block_world.answers, "field", [category.text], view)
        rows = flat.add("field", found, smoothing_of(found), None, category, [])
        expected |= {(row.query, row.metric): (row.value, row.protocol) for row in rows}
    maps = {text: relevancy_of(block_world.answers, "field", [text], view)[0] for text in TEXTS}
    labels = {text: region(row) for row, text in enumerate(TEXTS)}
    scores = hilsplat.score({view: maps}, {view: labels}, protocol)
    assert len(expected) == len(TEXTS) * len(card.metrics)
    found = {(row["query"], row["metric"]): (row["value"], scores.protocol) for row in scores.rows}
    assert found == expected
    assert scores.protocol == card.full_name  # the protocol's own rule was applied


def test_levels_and_their_consistency(block_world):
    def path_of(row):
        text, _, parent, *_ = NODES[row]
        return text if parent < 0 else f"{path_of(parent)} > {text}"

    labels = {path_of(row): region(row) for row in range(len(NODES))}
    found = {f"{LEVELS[level - 1].label}/{text}": region(row) for row, (text, level, *_) in enumerate(NODES)}
    scores = hilsplat.score({"v.png": found}, {"v.png": labels}, "hierarchy/level-given")
    assert scores.means["iou"] == scores.means["iou/whole"] == scores.means["iou/subpart"] == 1.0
    assert scores.means["hc_containment"] == 1.0
    found["part/head"] = np.zeros_like(region(0))  # one of two parts; levels are averaged, then the mean
    scores = hilsplat.score({"v.png": found}, {"v.png": labels}, "hierarchy/level-given")
    assert scores.means["iou/part"] == 0.5
    assert scores.means["iou"] == pytest.approx((1 + 0.5 + 1) / 3)
    assert scores.means["hc_containment"] < 1.0


@pytest.mark.parametrize("protocol", [name for name in POINTS if name.startswith("scannet/")])
def test_points_by_hand(protocol):
    wall, floor = SCANNET_10.ids[:2]
    truth = np.array([wall] * 6 + [floor] * 4 + [0] * 5)
    found = np.array([wall] * 3 + [floor] * 7 + [wall] * 5)  # points without a label don't count
    scores = hilsplat.score(found, truth, protocol)
    assert scores.means["miou_present"] == pytest.approx((3 / 6 + 4 / 7) / 2)
    assert scores.means["macc_present"] == pytest.approx((3 / 6 + 1) / 2)
    assert scores.protocol.endswith("(points: files)")


def test_classes_of_points_are_pooled_and_instances_matched():
    wall, floor = 1, 3
    truth, found = np.array([wall] * 6 + [floor] * 4), np.array([wall] * 3 + [floor] * 7)
    scores = hilsplat.score(found, truth, "scannet200/benchmark")
    assert scores.means["miou_occurring"] == pytest.approx((3 / 6 + 4 / 7) / 2)
    chair = SCANNET200_INSTANCES.ids[0]
    of_points, instances = np.full(400, chair), np.repeat([1, 2], 200)
    masks = np.stack([instances == 1, instances == 2])
    perfect = hilsplat.score((masks, [chair] * 2, [0.9, 0.8]), (of_points, instances), "scannet200/instances")
    assert perfect.means["ap"] == perfect.means["ap25"] == 1.0
    # the last one is far enough to be taken as an instance of the next class
    for number, kind in ((2**32 + 2, "i8"), (2**63 + 2, "u8"), (1002, "i2")):
        ids = np.repeat(np.array([2, number], kind), 200)
        again = hilsplat.score((masks, [chair] * 2, [0.9, 0.8]), (of_points, ids), "scannet200/instances")
        assert again.means["ap"] == again.means["ap25"] == 1.0
    absent = (masks, [chair] * 2, [0.9, 0.8]), (of_points + 2**32, instances)
    with pytest.raises(HilsplatError, match="contain nothing that scannet200/instances"):
        hilsplat.score(*absent, "scannet200/instances")
    half = hilsplat.score((masks[:1], [chair], [0.9]), (of_points, instances), "scannet200/instances")
    assert 0 < half.means["ap50"] < 1
    nothing = hilsplat.score((masks[:0], [], []), (of_points, instances), "scannet200/instances")
    assert nothing.means["ap50"] == 0


def test_every_protocol_scores_arrays_or_says_that_it_needs_more():
    assert set(SCORED.values()) | set(OF_THE_PIPELINE) == set(CARDS)
    for card in OF_THE_PIPELINE:
        with pytest.raises(HilsplatError, match=r"needs more than arrays(.|\n)*lerf/langsplat@3"):
            hilsplat.score({}, {}, card.name)


CUP = box((0, 4), (0, 8), SIZE)
LABELS = {"a": {"cup": CUP}}
LANGSPLAT, LEVELLED, ARGMAX = "lerf/langsplat", "hierarchy/level-given", "3d-ovs/argmax"
SCAN = "scannet200/instances"


@pytest.mark.parametrize(
    ("found", "labels", "protocol", "message"),
    [
        ({}, LABELS, LANGSPLAT, r"view 'a' has no predictions(.|\n)*an empty dict"),
        ({"a": {}, "b": {}}, LABELS, LANGSPLAT, "view 'b' has no labels"),
        ({"a": {"cpu": CUP}}, LABELS, LANGSPLAT, "rename it to 'cup'"),
        ({"a": {"cup": CUP[1:]}}, LABELS, LANGSPLAT, "expected  32 x 48"),
        ({"a": {"cup": CUP * 255}}, LABELS, LANGSPLAT, r"a: cup cannot .*(.|\n)*int64"),
        ({"a": {"cup": np.full((3, *SIZE), np.nan)}}, LABELS, LANGSPLAT, "finite relevancy"),
        ({"a": {"cup": np.full((3, *SIZE), np.inf)}}, LABELS, LANGSPLAT, "finite"),
        ({"a": {"cup": np.full((1, *SIZE), np.inf)}}, LABELS, ARGMAX, "finite"),
        ({"a": {"cup": CUP * np.ones((3, 1, 1))}}, LABELS, "lerf/opengaussian", "only masks, or"),
        (LABELS, LABELS, LEVELLED, "named like 'part/handle'"),
        ({"a": {"whole/cup": CUP}}, LABELS, LANGSPLAT, "without a level"),
        ({"a": {}}, {"a": {"cup": CUP.astype(int)}}, LANGSPLAT, "label 'cup' is not a region"),
        ({"a": {}}, {"a": {"cup": CUP, "mug": CUP[1:]}}, LANGSPLAT, "a: the labels differ in size"),
        ({"a": {}}, {"a": {}}, LANGSPLAT, "a: there are no labels"),
        ({"a": {}}, {"a": {"cup": CUP[:0]}}, LANGSPLAT, "label 'cup' is not a region"),
        ([CUP], [CUP], LANGSPLAT, "the predictions are not arrays by view and text"),
        (LABELS, {"a": CUP}, LANGSPLAT, "the labels are not arrays by view and text"),
        ({"a": {0: CUP}}, {"a": {0: CUP}}, LANGSPLAT, "the predictions are not arrays by view and text"),
        ({"a": {"cup": np.zeros((0, *SIZE))}}, LABELS, ARGMAX, "a: cup cannot be scored"),
        ((CUP[:2], [1] * 2, [0.5] * 2), 3, SCAN, r"masks \(M, P\) bool"),
        ({"a": {"cup": None}}, LABELS, LANGSPLAT, r"a: cup cannot be scored(.|\n)*\(\) object"),
        ({"a": {}}, {"a": {"cup": CUP & False}}, LANGSPLAT, "contain nothing that lerf/langsplat@3"),
        ({"a": {}}, {"a": {"a > b > c > d": CUP}}, LEVELLED, "more than 3 levels"),
        (3, 3, "replica/opennerf", r"same points(.|\n)*\(\) int64, \(\) int64"),
        (np.zeros(3, int), np.zeros(4, int), "replica/opennerf", r"same points(.|\n)*\(3,\) int64, \(4,\)"),
        ((np.ones((2, 4)), [1], [0.5]), ([1] * 4, [1] * 4), SCAN, r"masks \(M, P\) bool"),
        ((np.ones((2, 4), int), [1] * 2, [0.5] * 2), ([1] * 4, [1] * 4), SCAN, "M, P. bool"),
        ((CUP[:2], [1] * 2, [0.5, np.nan]), ([1] * 48, [1] * 48), SCAN, "finite confidences"),
        ((CUP[:2], [1] * 2, [0.5] * 2), ([1] * 48, [-1] * 48), SCAN, "0 for none"),
        ((np.ones((1, 1000), bool), [1], [0.5]), ([1] * 1000, range(1000)), SCAN, "fewer than"),
        ({}, {}, "lerf/langplat", "is unknown"),
    ],
)
def test_arrays_that_cannot_be_scored_are_refused(found, labels, protocol, message):
    with pytest.raises(HilsplatError, match=message):
        hilsplat.score(found, labels, protocol)


def test_texts_are_the_same_composed_or_decomposed():
    for text, label in (("cafe\u0301", "caf\xe9"), ("caf\xe9", "cafe\u0301")):
        assert hilsplat.score({"a": {text: CUP}}, {"a": {label: CUP}}).means["iou"] == 1


def test_masks_and_relevancy_cannot_be_mixed():
    labels = {"a": {"cup": CUP, "mug": ~CUP}}
    with pytest.raises(HilsplatError, match="cannot score these predictions"):
        hilsplat.score({"a": {"cup": CUP, "mug": np.zeros((3, *SIZE))}}, labels)
    cosines = {"cup": np.where(CUP, 0.9, 0.1)[None], "mug": np.full((1, *SIZE), 0.5)}
    assert hilsplat.score({"a": cosines}, labels, ARGMAX).means["pixel_accuracy"] == 1.0
    cosines["cup"] = np.stack([0 * cosines["cup"][0], cosines["cup"][0]])  # two levels; the mug has one
    assert hilsplat.score({"a": cosines}, labels, ARGMAX).means["pixel_accuracy"] == 1.0
