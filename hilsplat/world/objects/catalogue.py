"""All classes of objects that the synthetic world knows, and which kind of scene they stand in."""

import numpy as np

from hilsplat.base.errors import SceneError
from hilsplat.world.objects import (
    animals,
    belongings,
    fixtures,
    food,
    furniture,
    gadgets,
    garden,
    household,
    kitchen,
    storage,
    street,
    toys,
    vehicles,
)
from hilsplat.world.objects.builder import Builder, Maker, ObjectModel

GENERATOR_VERSION = 2
"""Changes whenever the same seed would give a different scene or different texts; small models trained on
another version do not fit."""

_MAKERS: dict[str, Maker] = {
    **toys.MAKERS,
    **animals.MAKERS,
    **vehicles.MAKERS,
    **kitchen.MAKERS,
    **food.MAKERS,
    **household.MAKERS,
    **gadgets.MAKERS,
    **belongings.MAKERS,
    **garden.MAKERS,
}

TABLETOP: tuple[str, ...] = tuple(_MAKERS)
"""Classes that stand on a table; all have about the same size there."""

FURNITURE: dict[str, Maker] = {
    **furniture.MAKERS,
    **storage.MAKERS,
    **fixtures.MAKERS,
    "chair": household.MAKERS["chair"],
    "cabinet": household.MAKERS["cabinet"],
}
"""Classes of a furnished room at their real size, in metres; a `lamp` is a floor lamp there."""

ROOM_THINGS: tuple[str, ...] = (
    *("bear", "snowman", "robot", "rocket", "car", "house", "penguin", "rabbit", "train"),
    *("mug", "kettle", "bottle", "cake", "fruit basket", "toaster"),
    *("radio", "camera", "backpack", "lantern", "plant", "cactus", "clock"),
)
"""Classes of the table that stand on furniture in a room; the small chairs and cabinets do not."""

STREET: dict[str, Maker] = street.MAKERS
"""Classes of a street at their real size, in metres; a `car` is not a toy there."""


def build_object(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw one object of a class of the table: sizes, colours, materials.

    Raises:
        SceneError: there is no such class.
    """
    return _drawn(name, maker_of(name), rng)


def build_furniture(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw one piece of furniture or one fixture of a room, in metres.

    Raises:
        SceneError: there is no such class.
    """
    return _drawn(name, _known(name, FURNITURE, "class of furniture"), rng)


def build_street_object(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw one vehicle, person, plant, building or piece of furniture of a street, in metres.

    Raises:
        SceneError: there is no such class.
    """
    return _drawn(name, _known(name, STREET, "class of a street"), rng)


def maker_of(name: str) -> Maker:
    """How a class of the table is drawn, and its other names.

    Raises:
        SceneError: there is no such class.
    """
    return _known(name, _MAKERS, "object class")


def _known(name: str, makers: dict[str, Maker], what: str) -> Maker:
    if name not in makers:
        raise SceneError(f"unknown {what} {name!r}", expected=f"one of {', '.join(makers)}")
    return makers[name]


def _drawn(name: str, maker: Maker, rng: np.random.Generator) -> ObjectModel:
    builder = Builder(name, maker.aliases, rng)
    maker.draw(builder)
    return builder.build()
