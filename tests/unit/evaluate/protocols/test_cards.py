"""Every protocol has a name and a version, and no number changes without a new version."""

import hashlib
import re
from dataclasses import asdict

import numpy as np
import pytest

import hilsplat
from hilsplat.base.errors import ArtifactError
from hilsplat.evaluate.protocols import cards
from hilsplat.evaluate.protocols.points import class_set
from hilsplat.evaluate.protocols.views import label_of
from hilsplat.evaluate.score import SCORED
from hilsplat.settings import EvaluateSettings
from tests.conftest import PROJECT
from tests.unit.evaluate.builders import box
from tests.unit.evaluate.protocols.test_protocols import SIZE, measured, worked_example

DECIDED = {
    # full name: digest of all that determines a number
    "lerf/langsplat@3": "d43dfb29",
    "lerf/tree-nodes@6": "4dfc2086",
    "lerf/langsplat-v2@3": "65314bd7",
    "lerf/paper-filter@3": "94d0aeec",
    "lerf/paper-mean@3": "48c2803c",
    "lerf/opengaussian@1": "51f63088",
    "lerf-mask/gaussian-grouping@1": "ac76d338",
    "lerf-mask/gaussian-grouping-skipping@1": "30c45b6e",
    "3d-ovs/argmax@3": "0569c777",
    "3d-ovs/langsplat@2": "3e9d5495",
    "3d-ovs/langsplat-raw@2": "83cf5c2a",
    "3d-ovs/langsplat-v2@3": "d1eef0f9",
    "3d-ovs/tree-nodes@1": "2871bf96",
    "scannet/opengaussian-19@1": "5cfd5215",
    "scannet/opengaussian-15@1": "540633c5",
    "scannet/opengaussian-10@1": "ade62598",
    "scannet200/opengaussian@1": "38d571c2",
    "scannet200/benchmark@1": "143662e3",
    "scannet200/instances@1": "369e6639",
    "replica/per-scene@1": "a8091a33",
    "replica/opennerf@1": "f1bdad4a",
    "replica/conceptgraphs@1": "a942dcfd",
    "waymo/segmentation@1": "820ca0d8",
    "hierarchy/level-given@6": "40e6ae22",
    "hierarchy/level-auto@7": "81da9fd0",
    "hierarchy/path@4": "4602f295",
    "hierarchy/scene-wide@2": "b748cc19",
    "hierarchy/annotations@1": "cfaa55f5",
    "world/view-consistency@2": "1b2df5f1",
}


def digests(folder):
    """Digest of each protocol's card, without explanations, and of its scores for fixed answers."""
    rng = np.random.default_rng(0)
    scene, truth = worked_example(folder, without=("a1",))
    constant = np.full((3, *SIZE), 0.5, np.float32)
    scene.maps = {"A": rng.integers(0, 9, constant.shape) / np.float32(8), "B": constant[:, ::-1] / 2}
    scene.maps |= {"b1": constant, "x": scene.maps["A"][::-1]}
    flat = tuple(card for card in cards.CARDS if card.averaging in ("pairs", "classes"))
    rows = [((key[1].split(" ")[0], *key), value) for key, value in measured(scene, truth, flat).items()]
    for name, card in SCORED.items():
        predictions, labels = {"v": {"cup": box((2, 9), (3, 9))}}, {"v": {"cup": box((3, 9), (0, 8))}}
        if card.classes:
            ids = [0, *class_set(card.classes)[1].ids[:6]]
            labels, predictions = rng.choice(ids[:-1], 2000), rng.choice(ids, 2000)
        if card is cards.INSTANCES:
            classes, counts = rng.choice(ids, 9), rng.integers(0, 2, 2000)
            masks = (labels == classes[:, None]) & (rng.random((9, 2000)) > 0.3)
            labels, predictions = (labels, counts), (masks, classes, rng.integers(1, 5, 9) / 4)
        if card is not cards.LEVEL_GIVEN:
            scores = hilsplat.score(predictions, labels, name)
            rows += [((name, *key), value) for key, value in scores.means.items()]
    explanations = {"selection", "source", "public"}
    decided = {
        card.full_name: (
            sorted((key, repr(value)) for key, value in asdict(card).items() if key not in explanations),
            sorted((key, f"{value:.4f}") for key, value in rows if key[0] == card.full_name),
        )
        for card in cards.CARDS
    }
    return {name: hashlib.sha256(repr(each).encode()).hexdigest()[:8] for name, each in decided.items()}


def test_a_protocol_changes_only_with_its_version(tmp_path):
    # An added or removed metric changes no other number, so it needs no new version.
    assert digests(tmp_path) == DECIDED, (
        "raise the version of a protocol that changed, then write its digest here"
    )


PUBLIC = re.compile(r"[\w.-]+/[\w.-]+@[0-9a-f]{7} \S+\.(py|cc)(:\w+)?")


def test_cards_are_named_after_benchmark_and_variant_and_state_their_source():
    assert len({card.name for card in cards.CARDS}) == len(cards.CARDS)
    for card in cards.CARDS:
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
    assert rows == {card.full_name: card.public or "none" for card in cards.CARDS}


CHANGED = {"filter_px": 20, "threshold_on": "raw", "node_select": 0.7, "relevancy_scale": 5}
RULE = {"mix": False, "relevancy_threshold": 0.5, "majority": False, "level_rule": "mean_in_mask"}


@pytest.mark.parametrize(
    ("card", "method", "settings", "departures"),
    [
        (cards.LERF_LANGSPLAT, "field", {}, ""),
        (cards.TREE_NODES, "tree", {}, ""),
        (cards.LERF_LANGSPLAT, "field", CHANGED, " (filter 20, raw, relevancy scale 5)"),
        (cards.LERF_LANGSPLAT, "field", RULE, " (no mix, threshold 0.5, no majority, mean_in_mask)"),
        (cards.TREE_NODES, "tree", {"ancestors": 0}, " (ancestors 0)"),
        # labels may lack a part's whole, so its path has one text
        (cards.PATH, "tree-path", {"ancestors": 0}, " (ancestors 0)"),
        # nodes are not thresholded, so the scale of the threshold doesn't affect them
        (cards.LEVEL_GIVEN, "tree", CHANGED, " (filter 20, node share 0.7, relevancy scale 5)"),
        (cards.LEVEL_GIVEN, "truth", CHANGED, ""),
        (cards.LEVEL_GIVEN, "tree", {"canonical": ("object", "scene")}, " (canonical object+scene)"),
    ],
)
def test_rows_name_the_settings_that_affect_them(card, method, settings, departures):
    assert label_of(card, method, EvaluateSettings(**settings)) == card.full_name + departures


def test_the_label_of_a_row_identifies_its_protocol():
    assert cards.card_of("lerf/langsplat@3 (filter 20, raw)") is cards.LERF_LANGSPLAT
    with pytest.raises(ArtifactError, match=r"no protocol 'lerf/langsplat@9'"):
        cards.card_of("lerf/langsplat@9")
