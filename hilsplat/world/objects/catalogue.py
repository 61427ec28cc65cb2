"""All classes of objects that the synthetic world knows, and which kind of scene they stand in."""

import numpy as np

from hilsplat.base.errors import SceneError
from hilsplat.world.objects import household, kitchen, toys
from hilsplat.world.objects.builder import Builder, Maker, ObjectModel

GENERATOR_VERSION = 2
"""Changes whenever the same seed would give another scene or other texts; small models trained on another
version do not fit."""

_MAKERS: dict[str, Maker] = {**toys.MAKERS, **kitchen.MAKERS, **household.MAKERS}

TABLETOP: tuple[str, ...] = (*toys.MAKERS, *kitchen.MAKERS, *household.MAKERS)
"""Classes that stand on a table; all are about as large there."""


def build_object(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw one object of a class: sizes, colours, materials.

    Raises:
        SceneError: there is no such class.
    """
    if name not in _MAKERS:
        raise SceneError(f"unknown object class {name!r}", expected=f"one of {', '.join(_MAKERS)}")
    maker = _MAKERS[name]
    builder = Builder(name, maker.aliases, rng)
    maker.draw(builder)
    return builder.build()
