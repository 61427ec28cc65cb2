"""Every protocol has a name and a version, and no number changes without a new version."""

import hashlib
import re
from dataclasses import asdict

import pytest

from hilsplat.base.errors import ArtifactError
from hilsplat.evaluate.protocols.cards import CARDS, LERF_LANGSPLAT, LEVEL_GIVEN, PATH, TREE_NODES, card_of
from hilsplat.evaluate.protocols.points import class_set
from hilsplat.evaluate.protocols.views import label_of
from hilsplat.settings import EvaluateSettings
from tests.conftest import PROJECT

DECIDED = {
    # full name: digest of all that determines a number
    "lerf/langsplat@2": "00e1f107",
    "lerf/tree-nodes@5": "1fa14c68",
    "lerf/langsplat-v2@2": "b0d9afb3",
    "lerf/paper-filter@2": "804964c0",
    "lerf/paper-mean@2": "5768b3cc",
    "lerf/opengaussian@1": "1b122683",
    "lerf-mask/gaussian-grouping@1": "e6d93a59",
    "lerf-mask/gaussian-grouping-skipping@1": "c241ea72",
    "3d-ovs/argmax@3": "1128109f",
    "3d-ovs/langsplat@2": "f6e46c55",
    "3d-ovs/langsplat-raw@2": "032c1219",
    "3d-ovs/langsplat-v2@3": "e9ed3d71",
    "3d-ovs/tree-nodes@1": "e097e501",
    "scannet/opengaussian-19@1": "d64c6a7c",
    "scannet/opengaussian-15@1": "9c2bf111",
    "scannet/opengaussian-10@1": "d9b46593",
    "scannet200/opengaussian@1": "55c18009",
    "scannet200/benchmark@1": "8ed63d14",
    "scannet200/instances@1": "c9866886",
    "replica/per-scene@1": "02a2f18f",
    "replica/opennerf@1": "3bd79743",
    "replica/conceptgraphs@1": "a221d8a0",
    "waymo/segmentation@1": "9622c7a0",
    "hierarchy/level-given@5": "cc1e20b7",
    "hierarchy/level-auto@6": "97938d15",
    "hierarchy/path@3": "90fed6d1",
    "hierarchy/scene-wide@2": "0ddcebe5",
    "hierarchy/annotations@1": "7aa18d6b",
    "world/view-consistency@2": "e5909c33",
}


def digest(card):
    """Digest of everything that determines a number, without the explanations."""
    explanations = ("selection", "source", "public")
    decided = {name: value for name, value in asdict(card).items() if name not in explanations}
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
    assert card_of("lerf/langsplat@2 (filter 20, raw)") is LERF_LANGSPLAT
    with pytest.raises(ArtifactError, match=r"no protocol 'lerf/langsplat@9'"):
        card_of("lerf/langsplat@9")
