"""Protocols that score a scene: those of its data set, or of the benchmarks that it substitutes for."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hilsplat.base.errors import SceneError
from hilsplat.base.levels import Level
from hilsplat.datasets.labelled import LabelledScene
from hilsplat.datasets.points.labelled_points import PointScene
from hilsplat.datasets.registry import dataset_of, open_labels
from hilsplat.evaluate.protocols.cards import ProtocolCard, card_of

WORLD_PROTOCOLS: Mapping[str, tuple[str, ...]] = {
    "tabletop": (*dataset_of("3d_ovs").protocols, "lerf-mask/gaussian-grouping"),
    "room": (
        *("scannet/opengaussian-19", "scannet/opengaussian-15", "scannet/opengaussian-10"),
        *("scannet200/opengaussian", "scannet200/benchmark", "scannet200/instances", "replica/per-scene"),
    ),
    "street": ("waymo/segmentation",),
}
"""Kind of synthetic scene -> protocols of the benchmarks that the kind substitutes for, besides LERF-OVS and
the level protocols."""


@dataclass(frozen=True)
class ExtraProtocols:
    """Protocols beyond those that score every labelled image (`protocols.views`).

    Flat protocols query only texts of `level`; None if the labels have no levels.
    """

    flat: tuple[ProtocolCard, ...] = ()
    points: tuple[ProtocolCard, ...] = ()
    level: Level | None = None

    @staticmethod
    def of_world(kind: str) -> "ExtraProtocols":
        """Return a synthetic scene's protocols, empty for kind ""; raise SceneError for unknown kinds."""
        if kind and kind not in WORLD_PROTOCOLS:
            raise SceneError(
                f"unknown kind of synthetic scene: {kind!r}",
                expected=f"one of {', '.join(WORLD_PROTOCOLS)}",
                fix="correct the kind, or omit it",
            )
        return ExtraProtocols.of(WORLD_PROTOCOLS.get(kind, ()), Level.WHOLE)

    @staticmethod
    def of(names: tuple[str, ...], level: Level | None = None) -> "ExtraProtocols":
        """Sort named protocols into those for images and those for points."""
        cards = [card_of(name) for name in names]
        points = tuple(card for card in cards if card.classes)
        return ExtraProtocols(tuple(card for card in cards if not card.classes), points, level)

    @staticmethod
    def open(name: str, data_root: Path) -> "tuple[str, LabelledScene | PointScene, ExtraProtocols]":
        """Return the data set, labels and protocols of a scene, by a name such as "lerf_ovs/figurines"."""
        dataset = name.partition("/")[0]
        return dataset, open_labels(name, data_root), ExtraProtocols.of(dataset_of(dataset).protocols)
