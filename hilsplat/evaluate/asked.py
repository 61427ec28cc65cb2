"""Which protocols a scene is scored under: those of its data set, or of the stand-in that it is."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hilsplat.base.errors import SceneError
from hilsplat.base.levels import Level
from hilsplat.datasets.labelled import LabelledScene
from hilsplat.datasets.points.labelled_points import PointScene
from hilsplat.datasets.registry import dataset_of, open_labels
from hilsplat.evaluate.protocols.cards import ProtocolCard, card_named

OVS = ("3d-ovs/langsplat", "3d-ovs/langsplat-raw", "3d-ovs/langsplat-v2", "3d-ovs/argmax")
SCANNET = ("scannet/opengaussian-19", "scannet/opengaussian-15", "scannet/opengaussian-10")
SCANNET200 = ("scannet200/opengaussian", "scannet200/instances")
REPLICA = ("replica/per-scene",)
WAYMO = ("waymo/segmentation",)

STAND_INS: Mapping[str, tuple[str, ...]] = {
    "tabletop": (*OVS, "lerf-mask/gaussian-grouping"),
    "room": (*SCANNET, *SCANNET200, *REPLICA),
    "street": WAYMO,
}
"""Kind of synthetic scene -> protocols for which it stands in, beside those of LERF-OVS and levels."""


@dataclass(frozen=True)
class Asked:
    """Protocols beyond those that every labelled image is scored under (`protocols.views`).

    Attributes:
        flat: protocols of texts without levels.
        points: protocols of labelled points.
        level: level whose texts the flat ones ask; None where the labels have no levels.
    """

    flat: tuple[ProtocolCard, ...] = ()
    points: tuple[ProtocolCard, ...] = ()
    level: Level | None = None

    @staticmethod
    def of_world(kind: str) -> "Asked":
        """Protocols of a stand-in; none for kind "".

        Raises:
            SceneError: there is no such kind.
        """
        if kind and kind not in STAND_INS:
            raise SceneError(
                f"a synthetic scene of kind {kind!r} stands in for no data set",
                expected=f"one of {', '.join(STAND_INS)}",
                fix="correct it, or leave it out",
            )
        return _asked(STAND_INS.get(kind, ()), Level.WHOLE)

    @staticmethod
    def of_dataset(name: str) -> "Asked":
        """Protocols that the data set names itself.

        Raises:
            SceneError: there is no such data set.
            ArtifactError: it names a protocol that is none.
        """
        return _asked(dataset_of(name).protocols, None)

    @staticmethod
    def open(name: str, data_root: Path) -> "tuple[str, LabelledScene | PointScene, Asked]":
        """Data set, labels and protocols of a scene named as in "lerf_ovs/figurines".

        Raises:
            SceneError: there is no such data set or scene, or it cannot be read.
        """
        dataset = name.partition("/")[0]
        return dataset, open_labels(name, data_root), Asked.of_dataset(dataset)


def _asked(names: tuple[str, ...], level: Level | None) -> Asked:
    cards = [card_named(name) for name in names]
    points = tuple(card for card in cards if card.classes)
    return Asked(tuple(card for card in cards if not card.classes), points, level)
