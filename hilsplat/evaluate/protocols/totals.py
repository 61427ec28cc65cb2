"""From rows to the number in a table, in the averaging order that the protocol states."""

from collections.abc import Mapping

from hilsplat.evaluate.metrics.averages import (
    Pairs,
    mean_over_classes,
    mean_over_pairs,
    mean_over_scenes,
)
from hilsplat.evaluate.protocols.cards import ProtocolCard


def scene_value(card: ProtocolCard, values: Pairs) -> float:
    """One scene's number from its (view, query) values; nan where there is none.

    For `levels`, give the pairs of one level at a time.
    """
    assert card.averaging != "pooled", f"{card.full_name} pools counts and has no number per scene"
    return mean_over_classes(values) if card.averaging == "classes" else mean_over_pairs(values)


def table_value(card: ProtocolCard, scenes: Mapping[str, Pairs]) -> float:
    """The mean of the scenes' numbers; every scene weighs the same."""
    return mean_over_scenes(scene_value(card, values) for values in scenes.values())
