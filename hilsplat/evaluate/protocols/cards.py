"""Protocols: the name, the version and everything else that determines a number measured under each.

The same model scores 51.4 under `lerf/langsplat` and 9.66 under `lerf/opengaussian`, so each row of
`scores.csv` has the full name, such as `lerf/langsplat@3`, then non-default settings in brackets. A change to
a card (`cards.json`) that affects its numbers requires a new version; a test checks this.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from hilsplat.base.errors import ArtifactError
from hilsplat.base.tables import described
from hilsplat.evaluate.metrics.relevancy_rule import RelevancyRule

STATED: dict[str, tuple[Any, Callable[[Any], str]]] = {
    "filter_px": (0, "filter {}".format),
    "mix": (True, lambda _: "no mix"),
    "relevancy_threshold": (0.4, "threshold {:g}".format),
    "threshold_on": ("normalised_pm1", str),
    "majority": (True, lambda _: "no majority"),
    "level_rule": ("max", str),
    "node_select": (0.95, "node share {:g}".format),
    "ancestors": (0.2, "ancestors {:g}".format),
    "canonical": (("object", "things", "stuff", "texture"), lambda phrases: f"canonical {'+'.join(phrases)}"),
    "template": ("{}", lambda template: f"texts as {template.replace('{}', '...')}"),
    "relevancy_scale": (10.0, "relevancy scale {:g}".format),
}
"""Setting of `evaluate` -> the value under which the cards hold, and words for any other value in names."""

MIN_REGION_PX = 60  # minimum area of a scored region of a generated scene; published labels have no minimum

Averaging = Literal["pairs", "classes", "levels", "views", "scenes", "pooled"]
"""How rows are averaged into one number of a table.

pairs: mean over the (view, query) pairs of a scene, then over scenes.
classes: mean over the views of a query, then over the queries of a scene, then over scenes.
levels: like `pairs` for each level; Avg is the mean of the levels.
views: mean over the views of a scene, then over scenes.
scenes: one number per scene, mean over scenes.
pooled: counts of all scenes are summed first, so each scene is weighted by its number of points.
"""


@dataclass(frozen=True)
class ProtocolCard:
    full_name: str  # `benchmark/variant@version`; a change below that affects the numbers needs a new version
    metrics: tuple[str, ...]
    averaging: Averaging
    selection: str  # how a prediction is chosen (threshold, level), in words
    source: str  # source code and departures from it; begins with "none" if no code is public
    rule: RelevancyRule | None = None  # how relevancy maps become masks, if they do
    missing: Literal["zero", "left out"] = "zero"  # pairs without a prediction; omitting them inflates scores
    classes: str = ""  # name of the queried `ClassSet`, if it is fixed
    # `labels`: the region that the data set defines; `any grey`: all non-black pixels of its mask file
    truth: Literal["labels", "any grey"] = "labels"
    united: tuple[tuple[str, str], ...] = ()  # (text, other): the answer to a text is the union of both masks
    # Public function with the same results up to rounding, except for the departures in `source`:
    # `owner/repository@commit file`, with `:function` where the file has several; "" if there is none.
    public: str = ""

    @property
    def name(self) -> str:
        return self.full_name.partition("@")[0]

    def labelled(self, departures: Iterable[str] = ()) -> str:
        """Return the name used in rows: the full name and any non-default settings."""
        words = ", ".join(departures)
        return f"{self.full_name} ({words})" if words else self.full_name


MASK = ("iou", "boundary_iou")
LOCALIZATION = ("localization_box", "localization_mask")


_ENTRIES = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
_BY_FULL_NAME = {entry["full_name"]: entry for entry in _ENTRIES}
CARDS: tuple[ProtocolCard, ...] = TypeAdapter(tuple[ProtocolCard, ...]).validate_python(
    [described(_BY_FULL_NAME, name) for name in _BY_FULL_NAME]
)
"""Every protocol, from `cards.json`; a `rule` there lists the fields that differ from `RelevancyRule`, and
`like` names a protocol from which omitted values are taken."""

BY_NAME: dict[str, ProtocolCard] = {name: card for card in CARDS for name in (card.name, card.full_name)}


def card_of(label: str) -> ProtocolCard:
    """Return the protocol with a name, with or without its version; settings in brackets are ignored.

    Raises:
        ArtifactError: no protocol has that name and version.
    """
    name = label.split(" (")[0]
    if name not in BY_NAME:
        raise ArtifactError(
            f"there is no protocol {name!r}",
            expected=f"one of {', '.join(card.full_name for card in CARDS)}",
            fix="delete the score file that names it and run evaluate again" if "@" in name else None,
        )
    return BY_NAME[name]


LERF_LANGSPLAT = card_of("lerf/langsplat")
LERF_OPENGAUSSIAN = card_of("lerf/opengaussian")
TREE_NODES = card_of("lerf/tree-nodes")
LERF_MASK = card_of("lerf-mask/gaussian-grouping")
LERF_MASK_SKIPPING = card_of("lerf-mask/gaussian-grouping-skipping")
OVS_ARGMAX = card_of("3d-ovs/argmax")
OVS_NODES = card_of("3d-ovs/tree-nodes")
INSTANCES = card_of("scannet200/instances")
LEVEL_GIVEN = card_of("hierarchy/level-given")
LEVEL_AUTO = card_of("hierarchy/level-auto")
PATH = card_of("hierarchy/path")
SCENE_WIDE = card_of("hierarchy/scene-wide")
ANNOTATIONS = card_of("hierarchy/annotations")
VIEW_CONSISTENCY = card_of("world/view-consistency")
