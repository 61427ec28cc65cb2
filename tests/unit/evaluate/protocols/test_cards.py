"""Every protocol has a name and a version, and no number changes without a new version."""

import hashlib
import re
from dataclasses import asdict

import pytest

from hilsplat.base.errors import ArtifactError
from hilsplat.evaluate.protocols.cards import CARDS, LERF_LANGSPLAT, LEVEL_GIVEN, TREE_NODES, card_of
from hilsplat.evaluate.protocols.points import class_set
from hilsplat.evaluate.protocols.views import label_of
from hilsplat.settings import EvaluateSettings
from tests.conftest import PROJECT

DECIDED = {
    # full name: digest of metrics, averaging, missing, rule and classes
    "lerf/langsplat@2": "704f6f3d",
    "lerf/tree-nodes@5": "2cdcbb8d",
    "lerf/langsplat-v2@2": "f209b912",
    "lerf/paper-filter@2": "128bc7c0",
    "lerf/paper-mean@2": "4fed36ea",
    "lerf/opengaussian@1": "68a14e17",
    "lerf-mask/gaussian-grouping@1": "34874a8b",
    "lerf-mask/gaussian-grouping-skipping@1": "b146f4ac",
    "3d-ovs/argmax@3": "44dac158",
    "3d-ovs/langsplat@2": "f962ef1a",
    "3d-ovs/langsplat-raw@2": "7797b61a",
    "3d-ovs/langsplat-v2@3": "107e57a0",
    "3d-ovs/tree-nodes@1": "3fb8af27",
    "scannet/opengaussian-19@1": "ced31f5d",
    "scannet/opengaussian-15@1": "df507111",
    "scannet/opengaussian-10@1": "e9893d38",
    "scannet200/opengaussian@1": "367d9a7d",
    "scannet200/benchmark@1": "af79327f",
    "scannet200/instances@1": "e9f60d74",
    "replica/per-scene@1": "5160df43",
    "replica/opennerf@1": "2368b7a9",
    "replica/conceptgraphs@1": "d89e022d",
    "waymo/segmentation@1": "06e4086c",
    "hierarchy/level-given@5": "69d8a3a5",
    "hierarchy/level-auto@6": "688db14e",
    "hierarchy/path@3": "6003caee",
    "hierarchy/scene-wide@2": "a57a3edc",
    "hierarchy/annotations@1": "2b3b53c4",
    "world/view-consistency@2": "c057895c",
}


LATER = {"empty_wins": False, "truth": "labels", "united": ()}


def digest(card):
    """Digest of everything that determines a number, without the explanations.

    Fields added later are included only if they differ from their default, so other digests are unchanged.
    """
    rule = asdict(card.rule) if card.rule else None
    if rule:
        rule["levels"] = [int(level) for level in rule["levels"]]
        rule = {key: value for key, value in rule.items() if key not in LATER or value != LATER[key]}
    decided = (card.metrics, card.averaging, card.missing, rule, card.classes)
    decided += tuple((key, value) for key, value in vars(card).items() if value != LATER.get(key, value))
    return hashlib.sha256(repr(decided).encode()).hexdigest()[:8]


def test_a_protocol_changes_only_with_its_version():
    found = {card.full_name: digest(card) for card in CARDS}
    # An added or removed metric changes no other number, so it needs no new version.
    assert found == DECIDED, "raise the version of a protocol that changed, then write its digest here"


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
        # nodes are not thresholded, so the scale of the threshold doesn't affect them
        (LEVEL_GIVEN, "tree", CHANGED, " (filter 20, node share 0.7, relevancy scale 5)"),
        (LEVEL_GIVEN, "truth", CHANGED, ""),
        (LEVEL_GIVEN, "tree", {"canonical": ("object", "scene")}, " (canonical object+scene)"),
    ],
)
def test_rows_name_the_settings_that_affect_them(card, method, settings, departures):
    assert label_of(card, method, EvaluateSettings(**settings)) == card.full_name + departures


def test_the_label_of_a_row_identifies_its_protocol():
    assert card_of("lerf/langsplat@2 (filter 20, raw)") is LERF_LANGSPLAT
    with pytest.raises(ArtifactError, match=r"no protocol 'lerf/langsplat@9'"):
        card_of("lerf/langsplat@9")
