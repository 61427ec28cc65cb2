"""All object classes of the synthetic world, by kind of scene."""

from collections.abc import Callable

import numpy as np

from hilsplat_world.objects import furniture, household, kitchen, street, toys
from hilsplat_world.objects.builder import Builder, ObjectModel

GENERATOR_VERSION = 2
"""Incremented whenever a seed yields a different scene or different queries; small models must be trained
with the same version."""

CLASSES: dict[str, dict[str, tuple[str, Callable[[Builder], None]]]] = {
    "tabletop": {  # objects of about the same size
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
        "train": ("locomotive, steam engine, toy train", toys.train),
        "sailboat": ("sailing boat, toy boat", toys.sailboat),
        "airplane": ("plane, aircraft", toys.airplane),
        "tractor": ("toy tractor, farm tractor", toys.tractor),
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
        "backpack": ("rucksack, school bag", household.backpack),
        "boot": ("winter boot, ankle boot", household.boot),
        "lantern": ("oil lantern, storm lantern", household.lantern),
        "treasure chest": ("pirate chest, money chest", household.chest),
        "cactus": ("saguaro, potted cactus", household.cactus),
        "windmill": ("mill, toy windmill", household.windmill),
        "birdhouse": ("nesting box, bird house", household.birdhouse),
        "watering can": ("garden can, sprinkling can", household.watering_can),
    },
    "room": {  # furniture and fixtures in metres; the lamp is a floor lamp
        "bed": ("sleeping bed", furniture.bed),
        "sofa": ("couch, settee", furniture.sofa),
        "table": ("coffee table, low table", furniture.table),
        "desk": ("writing desk, work desk", furniture.desk),
        "nightstand": ("bedside table, night table", furniture.nightstand),
        "lamp": ("floor lamp, standing lamp, light", furniture.floor_lamp),
        "rug": ("carpet, mat", furniture.rug),
        "stool": ("footstool, bar stool", furniture.stool),
        "bookshelf": ("bookcase, book shelf", furniture.bookshelf),
        "refrigerator": ("fridge, icebox", furniture.refrigerator),
        "counter": ("kitchen counter, kitchen unit", furniture.counter),
        "sink": ("washbasin, kitchen sink", furniture.sink),
        "tv stand": ("media console, tv bench", furniture.tv_stand),
        "television": ("tv, tv screen", furniture.television),
        "monitor": ("computer monitor, computer screen", furniture.monitor),
        "door": ("room door", furniture.door),
        "window": ("casement window", furniture.window),
        "curtain": ("curtains, drapery", furniture.curtain),
        "picture": ("framed picture, wall painting", furniture.picture),
        "mirror": ("wall mirror, round mirror", furniture.mirror),
        "chair": ("dining chair, side chair", household.chair),
        "cabinet": ("cupboard, sideboard", household.cabinet),
    },
    "street": {  # full size, in metres; the car is not a toy
        "car": ("vehicle, automobile", street.car),
        "truck": ("vehicle, lorry", street.truck),
        "bus": ("vehicle, coach", street.bus),
        "pedestrian": ("person, walker", street.pedestrian),
        "cyclist": ("bicyclist, bike rider", street.cyclist),
        "building": ("town house, apartment building", street.building),
        "tree": ("vegetation, street tree", street.tree),
        "bush": ("vegetation, shrub", street.bush),
        "traffic sign": ("sign, road sign", street.sign),
        "traffic light": ("traffic signal, stoplight", street.traffic_light),
        "street lamp": ("lamp post, street light", street.street_lamp),
        "fence": ("railing, picket fence", street.fence),
    },
}
"""Object classes by kind of scene and name. Each class has aliases, and a function that adds parts, subparts
and meshes to a builder, with random sizes and paints."""

TABLETOP = tuple(CLASSES["tabletop"])

ROOM_THINGS: tuple[str, ...] = (
    *("bear", "snowman", "robot", "rocket", "car", "house", "penguin", "rabbit", "train"),
    *("mug", "kettle", "bottle", "cake", "fruit basket", "toaster"),
    *("radio", "camera", "backpack", "lantern", "plant", "cactus", "clock"),
)
"""Tabletop classes placed on furniture in a room; small chairs and cabinets are excluded."""


def build_object(kind: str, name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw an object of a class with random sizes, colours and materials.

    Args:
        kind: kind of scene whose classes include the object.
        name: class of the object, one of `CLASSES[kind]`.
    """
    aliases, draw = CLASSES[kind][name]
    builder = Builder(f"{name}, {aliases}", rng)
    draw(builder)
    return builder.build()
