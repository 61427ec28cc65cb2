"""Every protocol has a name and a version, and no number changes without a new version."""

import hashlib
import re
from dataclasses import asdict

import numpy as np
import pytest

import hilsplat
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import Level
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.protocols.answers import PackedMasks, Selections
from hilsplat.evaluate.protocols.cards import (
    CARDS,
    INSTANCES,
    LERF_LANGSPLAT,
    LEVEL_GIVEN,
    PATH,
    TREE_NODES,
    card_of,
)
from hilsplat.evaluate.protocols.points import class_set
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.protocols.views import label_of, measure_view
from hilsplat.evaluate.score import SCORED
from hilsplat.settings import EvaluateSettings
from tests.conftest import PROJECT
from tests.unit.evaluate.builders import HandMade, box, region_of

DECIDED = {
    # full name: digest of all that determines a number
    "lerf/langsplat@3": "d23d3910",
    "lerf/tree-nodes@6": "39469e82",
    "lerf/langsplat-v2@3": "5aaf19cd",
    "lerf/paper-filter@3": "47a7c534",
    "lerf/paper-mean@3": "fb3ac8d6",
    "lerf/opengaussian@1": "a4ffff06",
    "lerf-mask/gaussian-grouping@1": "40f271f1",
    "lerf-mask/gaussian-grouping-skipping@1": "f6f3bcd9",
    "3d-ovs/argmax@3": "46733171",
    "3d-ovs/langsplat@2": "361dc448",
    "3d-ovs/langsplat-raw@2": "d787304f",
    "3d-ovs/langsplat-v2@3": "b7498973",
    "3d-ovs/tree-nodes@1": "073a53bf",
    "scannet/opengaussian-19@1": "f4554681",
    "scannet/opengaussian-15@1": "2698bc3a",
    "scannet/opengaussian-10@1": "383ae9c8",
    "scannet200/opengaussian@1": "e2233b62",
    "scannet200/benchmark@1": "f3fa6245",
    "scannet200/instances@1": "457a8e45",
    "replica/per-scene@1": "fe539e49",
    "replica/opennerf@1": "acaecbf3",
    "replica/conceptgraphs@1": "d5538acc",
    "waymo/segmentation@1": "dbce9ca2",
    "hierarchy/level-given@6": "2d3edb0d",
    "hierarchy/level-auto@7": "a5233133",
    "hierarchy/path@4": "b2b26394",
    "hierarchy/scene-wide@2": "5da0401e",
    "hierarchy/annotations@1": "6192fc96",
    "world/view-consistency@2": "513ed7e3",
}


SIZE, TEXTS = (96, 128), ("wood wall", "wood table", "nose", "nothing", "constant")


def scores_of_images():
    """Scores of fixed answers, some empty or constant, by our own evaluation and as arrays of a program."""
    rng = np.random.default_rng(0)
    paths = {TEXTS[0]: TEXTS[:1], **{text: (TEXTS[0], text) for text in TEXTS[1:]}}
    low = dict(zip(TEXTS, rng.integers(0, 40, (len(TEXTS), 2)).tolist(), strict=True))
    regions = {text: box((top, top + 48), (left, left + 64), SIZE) for text, (top, left) in low.items()}
    maps = {text: rng.integers(0, 9, (3, 12, 16)).repeat(8, 1).repeat(8, 2) / 16 for text in TEXTS[:3]}
    maps = {name: values.astype(np.float32) for name, values in maps.items()}
    maps |= {"nothing": np.zeros((3, *SIZE), np.float32), "constant": np.full((3, *SIZE), 0.5, np.float32)}
    masks = [rng.random((6, 8)).repeat(16, 0).repeat(16, 1) > 0.5 for _ in TEXTS]
    nodes = {path: [row] for row, path in enumerate(paths.values()) if path[-1] != "nothing"}
    nodes |= {(path[-1], level): row for path, row in nodes.items() for level in (None, Level(len(path)))}
    scene = HandMade(masks, nodes, maps, SIZE)
    labelled = {
        text: region_of(mask, text, Level(len(paths[text])), paths[text]) for text, mask in regions.items()
    }
    truth, flat = (
        ViewTruth.of_regions(labelled.values(), SIZE),
        tuple(card for card in CARDS if card.averaging in ("pairs", "classes")),
    )
    rows = measure_view(
        Selections(scene), truth, "v.png", PackedMasks(SIZE), EvaluateSettings(), ExtraProtocols(flat)
    )
    for row in rows:
        yield row.protocol.split(" ")[0], vars(row)
    predicted = {text: masks[row] for row, text in enumerate(TEXTS) if text != "nothing"}
    for name in (name for name, card in SCORED.items() if not card.classes and card is not LEVEL_GIVEN):
        for row in hilsplat.score({"v.png": predicted}, {"v.png": regions}, name).rows:
            yield name, row


def scores_of_points():
    """Scores of fixed class ids and instances as arrays of a program."""
    for name, card in SCORED.items():
        if card.classes:
            rng, ids = np.random.default_rng(0), [0, *class_set(card.classes)[1].ids[:6]]
            labels, predictions = rng.choice(ids[:-1], 2000), rng.choice(ids, 2000)
            if card is INSTANCES:
                classes = rng.choice(ids, 9)
                masks = (labels == classes[:, None]) & (rng.random((9, 2000)) > 0.3)
                predictions = masks, classes, rng.integers(1, 5, 9) / 4
                labels = labels, rng.integers(0, 2, 2000)
            scores = hilsplat.score(predictions, labels, name)
            for row in (*scores.rows, scores.means):
                yield name, row


@pytest.fixture(scope="module")
def digests():
    """Digest of each protocol: its card without explanations, and scores under it, to four decimals."""
    explanations = ("selection", "source", "public")
    decided = {
        card.full_name: {k: v for k, v in asdict(card).items() if k not in explanations} for card in CARDS
    }
    rows = {name: [] for name in decided}
    for name, row in (*scores_of_images(), *scores_of_points()):
        rows[name].append(repr({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}))
    return {
        name: hashlib.sha256(repr((decided[name], sorted(rows[name]))).encode()).hexdigest()[:8]
        for name in decided
    }


def test_a_protocol_changes_only_with_its_version(digests):
    # An added or removed metric changes no other number, so it needs no new version.
    assert digests == DECIDED, "raise the version of a protocol that changed, then write its digest here"


PUBLIC = re.compile(r"[\w.-]+/[\w.-]+@[0-9a-f]{7} \S+\.(py|cc)(:\w+)?")


def test_cards_are_named_after_benchmark_and_variant_and_state_their_source():
    assert len({card.name for card in CARDS}) == len(CARDS)
    for card in CARDS:
        assert re.fullmatch("[^/]+/[^/]+", card.name)
        assert card.selection and card.source
        assert not card.classes or class_set(card.classes)[1].name == card.classes
        assert bool(card.public) != card.source.startswith("none"), card.name
        assert not card.public or PUBLIC.fullmatch(card.public), card.public


def test_the_documentation_lists_every_protocol_with_its_public_function():
    rows = {}
    for line in (PROJECT / "docs" / "tables.md").read_text(encoding="utf-8").splitlines():
        if re.match(r"\| `[\w/-]+@\d", line):
            names, public, *_ = (cell.strip() for cell in line.strip("|").split("|"))
            rows |= dict.fromkeys(re.findall(r"`([^`]+)`", names), public.strip("`"))
    assert rows == {card.full_name: card.public or "none" for card in CARDS}


CHANGED = {"filter_px": 20, "threshold_on": "raw", "node_select": 0.7, "relevancy_scale": 5}
RULE = {"mix": False, "relevancy_threshold": 0.5, "majority": False, "level_rule": "mean_in_mask"}


@pytest.mark.parametrize(
    ("card", "method", "settings", "departures"),
    [
        (LERF_LANGSPLAT, "field", {}, ""),
        (TREE_NODES, "tree", {}, ""),
        (LERF_LANGSPLAT, "field", CHANGED, " (filter 20, raw, relevancy scale 5)"),
        (LERF_LANGSPLAT, "field", RULE, " (no mix, threshold 0.5, no majority, mean_in_mask)"),
        (TREE_NODES, "tree", {"ancestors": 0}, " (ancestors 0)"),
        # labels may lack a part's whole, so its path has one text
        (PATH, "tree-path", {"ancestors": 0}, " (ancestors 0)"),
        # nodes are not thresholded, so the scale of the threshold doesn't affect them
        (LEVEL_GIVEN, "tree", CHANGED, " (filter 20, node share 0.7, relevancy scale 5)"),
        (LEVEL_GIVEN, "truth", CHANGED, ""),
        (LEVEL_GIVEN, "tree", {"canonical": ("object", "scene")}, " (canonical object+scene)"),
    ],
)
def test_rows_name_the_settings_that_affect_them(card, method, settings, departures):
    assert label_of(card, method, EvaluateSettings(**settings)) == card.full_name + departures


def test_the_label_of_a_row_identifies_its_protocol():
    assert card_of("lerf/langsplat@3 (filter 20, raw)") is LERF_LANGSPLAT
    with pytest.raises(ArtifactError, match=r"no protocol 'lerf/langsplat@9'"):
        card_of("lerf/langsplat@9")
