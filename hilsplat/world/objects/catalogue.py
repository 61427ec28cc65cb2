"""All object classes of the synthetic world, by kind of scene."""

from collections.abc import Callable

import numpy as np

from hilsplat.base.errors import SceneError
from hilsplat.world.objects import (
    belongings,
    furniture,
    household,
    kitchen,
    storage,
    street,
    toys,
    traffic,
    vehicles,
)
from hilsplat.world.objects.builder import Builder, ObjectModel

GENERATOR_VERSION = 2
"""Incremented whenever a seed gives a different scene or different texts; small models must be trained on
the same version."""

# Aliases of each class, and a function that adds the parts, subparts and meshes of an object, with random
# sizes and paints, to a builder.
_Makers = dict[str, tuple[str, Callable[[Builder], None]]]

_TABLETOP: _Makers = {
    "bear": ("teddy bear, teddy, stuffed bear", toys.bear),
    "snowman": ("snow figure", toys.snowman),
    "robot": ("toy robot, android", toys.robot),
    "rocket": ("toy rocket, spaceship", toys.rocket),
    "car": ("toy car, automobile", toys.car),
    "house": ("toy house, cottage", toys.house),
    "duck": ("rubber duck, duckling", toys.duck),
    "penguin": ("toy penguin", toys.penguin),
    "turtle": ("tortoise", toys.turtle),
    "rabbit": ("bunny, hare", toys.rabbit),
    "train": ("locomotive, steam engine, toy train", vehicles.train),
    "sailboat": ("sailing boat, toy boat", vehicles.sailboat),
    "airplane": ("plane, aircraft", vehicles.airplane),
    "tractor": ("toy tractor, farm tractor", vehicles.tractor),
    "mug": ("coffee mug, tea mug", kitchen.mug),
    "kettle": ("teapot, tea kettle", kitchen.kettle),
    "bottle": ("flask, glass bottle", kitchen.bottle),
    "cake": ("birthday cake, torte", kitchen.cake),
    "frying pan": ("skillet", kitchen.frying_pan),
    "burger": ("hamburger, cheeseburger", kitchen.burger),
    "fruit basket": ("fruit bowl, basket of fruit", kitchen.fruit_basket),
    "ice cream": ("ice cream sundae, gelato", kitchen.ice_cream),
    "chair": ("dining chair, side chair", household.chair),
    "cabinet": ("cupboard, sideboard", household.cabinet),
    "lamp": ("table lamp, light", household.lamp),
    "shelf": ("shelving unit, book rack", household.shelf),
    "plant": ("potted plant, flower plant", household.plant),
    "clock": ("alarm clock, timepiece", household.clock),
    "guitar": ("acoustic guitar, string instrument", household.guitar),
    "radio": ("portable radio, transistor radio", household.radio),
    "camera": ("photo camera, compact camera", household.camera),
    "toaster": ("bread toaster", household.toaster),
    "headphones": ("headset, earphones", household.headphones),
    "backpack": ("rucksack, school bag", belongings.backpack),
    "boot": ("winter boot, ankle boot", belongings.boot),
    "lantern": ("oil lantern, storm lantern", belongings.lantern),
    "treasure chest": ("pirate chest, money chest", belongings.chest),
    "cactus": ("saguaro, potted cactus", belongings.cactus),
    "windmill": ("mill, toy windmill", belongings.windmill),
    "birdhouse": ("nesting box, bird house", belongings.birdhouse),
    "watering can": ("garden can, sprinkling can", belongings.watering_can),
}

_FURNITURE: _Makers = {
    "bed": ("sleeping bed", furniture.bed),
    "sofa": ("couch, settee", furniture.sofa),
    "table": ("coffee table, low table", furniture.table),
    "desk": ("writing desk, work desk", furniture.desk),
    "nightstand": ("bedside table, night table", furniture.nightstand),
    "lamp": ("floor lamp, standing lamp, light", furniture.floor_lamp),
    "rug": ("carpet, mat", furniture.rug),
    "stool": ("footstool, bar stool", furniture.stool),
    "bookshelf": ("bookcase, book shelf", storage.bookshelf),
    "refrigerator": ("fridge, icebox", storage.refrigerator),
    "counter": ("kitchen counter, kitchen unit", storage.counter),
    "sink": ("washbasin, kitchen sink", storage.sink),
    "tv stand": ("media console, tv bench", storage.tv_stand),
    "television": ("tv, tv screen", storage.television),
    "monitor": ("computer monitor, computer screen", storage.monitor),
    "door": ("room door", furniture.door),
    "window": ("casement window", furniture.window),
    "curtain": ("curtains, drapery", furniture.curtain),
    "picture": ("framed picture, wall painting", furniture.picture),
    "mirror": ("wall mirror, round mirror", furniture.mirror),
    "chair": ("dining chair, side chair", household.chair),
    "cabinet": ("cupboard, sideboard", household.cabinet),
}

_STREET: _Makers = {
    "car": ("vehicle, automobile", traffic.car),
    "truck": ("vehicle, lorry", traffic.truck),
    "bus": ("vehicle, coach", traffic.bus),
    "pedestrian": ("person, walker", traffic.pedestrian),
    "cyclist": ("bicyclist, bike rider", traffic.cyclist),
    "building": ("town house, apartment building", street.building),
    "tree": ("vegetation, street tree", street.tree),
    "bush": ("vegetation, shrub", street.bush),
    "traffic sign": ("sign, road sign", street.sign),
    "traffic light": ("traffic signal, stoplight", street.traffic_light),
    "street lamp": ("lamp post, street light", street.street_lamp),
    "fence": ("railing, picket fence", street.fence),
}


TABLETOP = tuple(_TABLETOP)
"""Classes of tabletop scenes, where all objects have about the same size."""

FURNITURE = tuple(_FURNITURE)
"""Classes of furniture and fixtures in a room, full size, in metres; `lamp` is a floor lamp here."""

STREET = tuple(_STREET)
"""Classes of a street, full size, in metres; `car` is not a toy here."""

ROOM_THINGS: tuple[str, ...] = (
    *("bear", "snowman", "robot", "rocket", "car", "house", "penguin", "rabbit", "train"),
    *("mug", "kettle", "bottle", "cake", "fruit basket", "toaster"),
    *("radio", "camera", "backpack", "lantern", "plant", "cactus", "clock"),
)
"""Tabletop classes that are placed on furniture in a room; small chairs and cabinets are excluded."""


def build_object(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw an object of a tabletop class with random sizes, colours and materials.

    Raises:
        SceneError: if there is no such class (from the other `build` functions too).
    """
    return _drawn(name, _TABLETOP, "object class", rng)


def build_furniture(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw a piece of furniture or a fixture of a room, in metres."""
    return _drawn(name, _FURNITURE, "class of furniture", rng)


def build_street_object(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw a vehicle, person, plant, building or piece of street furniture, in metres."""
    return _drawn(name, _STREET, "class of a street", rng)


def _drawn(name: str, makers: _Makers, what: str, rng: np.random.Generator) -> ObjectModel:
    if name not in makers:
        raise SceneError(f"unknown {what} {name!r}", expected=f"one of {', '.join(makers)}")
    aliases, draw = makers[name]
    builder = Builder(f"{name}, {aliases}", rng)
    draw(builder)
    return builder.build()
