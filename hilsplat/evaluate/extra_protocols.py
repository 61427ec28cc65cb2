"""Protocols that score a scene: those of its data set or kind of generated scene."""

from dataclasses import dataclass
from pathlib import Path

from hilsplat.base.levels import Level
from hilsplat.datasets.generators import Truth, generator_of
from hilsplat.datasets.labelled import LabelledScene
from hilsplat.datasets.points.labelled_points import PointScene
from hilsplat.datasets.registry import dataset_of, open_labels
from hilsplat.evaluate.protocols.cards import ProtocolCard, card_of


@dataclass(frozen=True)
class ExtraProtocols:
    """Protocols beyond those that score every labelled image (`protocols.views`).

    Flat protocols query only texts of `level`; None if the labels have no levels.
    """

    flat: tuple[ProtocolCard, ...] = ()
    points: tuple[ProtocolCard, ...] = ()
    level: Level | None = None

    @staticmethod
    def of(names: tuple[str, ...], level: Level | None = None) -> "ExtraProtocols":
        """Sort named protocols into those for images and those for points."""
        cards = [card_of(name) for name in names]
        points = tuple(card for card in cards if card.classes)
        return ExtraProtocols(tuple(card for card in cards if not card.classes), points, level)

    @staticmethod
    def generated(source: str, truth: Path) -> "tuple[Truth, ExtraProtocols]":
        """Return the ground truth and protocols of a generated scene, by its source and folder of truth.

        Without a source, only annotated images are scored.
        """
        if not source:
            return Truth(truth), ExtraProtocols(level=Level.WHOLE)
        generator, generated = generator_of(source)
        protocols = generator.kinds[generated.kind].protocols
        return generator.open(truth, generated.kind), ExtraProtocols.of(protocols, Level.WHOLE)

    @staticmethod
    def open(name: str, data_root: Path) -> "tuple[str, LabelledScene | PointScene, ExtraProtocols]":
        """Return the data set, labels and protocols of a scene, by a name such as "lerf_ovs/figurines"."""
        dataset = name.partition("/")[0]
        return dataset, open_labels(name, data_root), ExtraProtocols.of(dataset_of(dataset).protocols)
