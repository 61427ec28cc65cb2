"""All object classes of the synthetic world, by kind of scene."""

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
"""Incremented whenever a seed gives a different scene or different texts; small models must be trained on
the same version."""

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
"""Classes of tabletop scenes, where all objects have about the same size."""

FURNITURE: dict[str, Maker] = {
    **furniture.MAKERS,
    **storage.MAKERS,
    **fixtures.MAKERS,
    "chair": household.MAKERS["chair"],
    "cabinet": household.MAKERS["cabinet"],
}
"""Classes of furniture and fixtures in a room, full size, in metres; `lamp` is a floor lamp here."""

ROOM_THINGS: tuple[str, ...] = (
    *("bear", "snowman", "robot", "rocket", "car", "house", "penguin", "rabbit", "train"),
    *("mug", "kettle", "bottle", "cake", "fruit basket", "toaster"),
    *("radio", "camera", "backpack", "lantern", "plant", "cactus", "clock"),
)
"""Tabletop classes that are placed on furniture in a room; small chairs and cabinets are excluded."""

STREET: dict[str, Maker] = street.MAKERS
"""Classes of a street, full size, in metres; `car` is not a toy here."""


def build_object(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw an object of a tabletop class with random sizes, colours and materials.

    Raises:
        SceneError: if there is no such class.
    """
    return _drawn(name, _MAKERS, "object class", rng)


def build_furniture(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw a piece of furniture or a fixture of a room, in metres.

    Raises:
        SceneError: if there is no such class.
    """
    return _drawn(name, FURNITURE, "class of furniture", rng)


def build_street_object(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw a vehicle, person, plant, building or piece of street furniture, in metres.

    Raises:
        SceneError: if there is no such class.
    """
    return _drawn(name, STREET, "class of a street", rng)


def _drawn(name: str, makers: dict[str, Maker], what: str, rng: np.random.Generator) -> ObjectModel:
    if name not in makers:
        raise SceneError(f"unknown {what} {name!r}", expected=f"one of {', '.join(makers)}")
    builder = Builder(name, makers[name].aliases, rng)
    makers[name].draw(builder)
    return builder.build()
