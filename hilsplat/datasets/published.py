"""Published frames and prompts of the image-labelled data sets.

Labels on disk take precedence: these lists only help to report missing, misspelt or mismatched labels.

Sources. `FRAMES`: LERF-OVS from the released labels (minghanqin/LangSplat); 3D-OVS from third-party loaders,
bed, bench and lawn also from a second repository; Hi-LERF and Hi-3DOVS from the table of the Hi-LSplat paper
(its `frame_01` of a 3D-OVS scene is image 01). `PROMPTS`: LERF-OVS from yanmin-wu/OpenGaussian, LERF-Mask
from lkeab/gaussian-grouping, 3D-OVS bed to sofa from published evaluation code; blue_sofa, snacks and
office_desk from figure captions of the LangSplat supplement, perhaps incomplete; covered_desk, table: none.
"""

from hilsplat.scene.view_names import view_name


def _lerf(*numbers: int) -> tuple[str, ...]:
    return tuple(view_name(f"frame_{number:05d}") for number in numbers)


def _ovs(*numbers: int) -> tuple[str, ...]:
    return tuple(view_name(f"{number:02d}") for number in numbers)


def _texts(listed: str) -> tuple[str, ...]:
    return tuple(listed.split(", "))


FRAMES: dict[str, dict[str, tuple[str, ...]]] = {
    "lerf_ovs": {
        "figurines": _lerf(41, 105, 152, 195),
        "ramen": _lerf(6, 24, 60, 65, 81, 119, 128),
        "teatime": _lerf(2, 25, 43, 107, 129, 140),
        "waldo_kitchen": _lerf(53, 66, 89, 140, 154),
    },
    "3d_ovs": {
        "bed": _ovs(0, 4, 10, 23, 30),
        "bench": _ovs(2, 5, 25, 27, 32),
        "blue_sofa": _ovs(3, 5, 13, 24, 27),
        "covered_desk": _ovs(0, 1, 11, 26, 29),
        "lawn": _ovs(1, 3, 9, 13, 29),
        "office_desk": _ovs(3, 7, 12, 14, 20),
        "room": _ovs(0, 4, 19, 25, 30),
        "snacks": _ovs(4, 8, 18, 26, 40),
        "sofa": _ovs(2, 4, 10, 15, 22),
        "table": _ovs(0, 2, 14, 26, 30),
    },
    "hi_lerf": {
        "figurines": _lerf(16, 41, 60, 105, 122, 152, 176, 195, 226, 260),
        "ramen": _lerf(6, 24, 42, 60, 65, 81, 94, 104, 119, 128),
        "teatime": _lerf(2, 25, 43, 107, 116, 125, 129, 140, 158, 180),
        "waldo_kitchen": _lerf(10, 20, 33, 53, 66, 89, 125, 140, 154, 186),
    },
    "hi_3dovs": {
        "bed": _ovs(1, 6, 11, 20, 28, 36),
        "bench": _ovs(2, 5, 25, 27, 32, 35),
        "blue_sofa": _ovs(3, 5, 13, 24, 27, 29),
        "covered_desk": _ovs(0, 11, 15, 21, 26, 30),
        "lawn": _ovs(1, 3, 9, 13, 29, 35),
        "office_desk": _ovs(3, 7, 12, 14, 20, 26),
        "room": _ovs(0, 4, 10, 19, 25, 30),
        "snacks": _ovs(4, 8, 16, 26, 36, 40),
        "sofa": _ovs(2, 4, 10, 15, 22, 27),
        "table": _ovs(0, 2, 14, 26, 30, 31),
    },
}
"""Labelled frames by data set and scene, as view names."""

PROMPTS: dict[str, dict[str, tuple[str, ...]]] = {
    "lerf_ovs": {
        "figurines": _texts(
            "bag, green apple, green toy chair, jake, miffy, old camera, pikachu, pink ice cream, "
            "pirate hat, porcelain hand, pumpkin, red apple, red toy chair, rubber duck with buoy, "
            "rubber duck with hat, rubics cube, spatula, tesla door handle, toy cat statue, toy elephant, "
            "waldo"
        ),
        "ramen": _texts(
            "bowl, chopsticks, corn, egg, glass of water, hand, kamaboko, napkin, nori, onion segments, "
            "plate, sake cup, spoon, wavy noodles"
        ),
        "teatime": _texts(
            "apple, bag of cookies, bear nose, coffee, coffee mug, dall-e brand, hooves, paper napkin, "
            "plate, sheep, stuffed bear, tea in a glass, three cookies, yellow pouf"
        ),
        "waldo_kitchen": _texts(
            "Stainless steel pots, cabinet, dark cup, frog cup, ketchup, knife, ottolenghi, "
            "plastic ladle, plate, pot, pour-over vessel, red cup, refrigerator, sink, spatula, spoon, "
            "toaster, yellow desk"
        ),
    },
    "lerf_mask": {
        "figurines": _texts(
            "green apple, green toy chair, old camera, porcelain hand, red apple, red toy chair, "
            "rubber duck with red hat"
        ),
        "ramen": _texts("chopsticks, egg, glass of water, pork belly, wavy noodles in bowl, yellow bowl"),
        "teatime": _texts(
            "apple, bag of cookies, coffee mug, cookies on a plate, paper napkin, plate, sheep, "
            "spoon handle, stuffed bear, tea in a glass"
        ),
    },
    "3d_ovs": {
        "bed": _texts("banana, black leather shoe, camera, hand, red bag, white sheet"),
        "bench": _texts(
            "Portuguese egg tart, dressing doll, green grape, mini offroad car, orange cat, "
            "pebbled concrete wall, wood"
        ),
        "blue_sofa": _texts(
            "a JBL Bluetooth speaker, a bottle of perfume, a squirrel pig doll, an aircon controller, "
            "blue-grey sofa, sunglasses"
        ),
        "lawn": _texts("New York Yankees cap, black headphone, green lawn, hand soap, red apple, stapler"),
        "office_desk": _texts(
            "a can of red bull drink, a pack of pocket tissues, a white keyboard, blue partition, "
            "desktop, the book of The Unbearable Lightness of Being"
        ),
        "room": _texts("baseball, dinosaur, rabbit, shrilling chicken, weaving basket, wood wall"),
        "snacks": _texts(
            "Coke Cola, Glico Pocky chocolate biscuits sticks box, calculator, desktop, "
            "orange juice drink, pitaya"
        ),
        "sofa": _texts(
            "Gundam, Pikachu, Xbox wireless controller, a red Nintendo Switch joy-con controller, "
            "a stack of UNO cards, grey sofa"
        ),
    },
}
"""Prompts by data set and scene, sorted."""

PAIRS: dict[str, int] = {"figurines": 56, "ramen": 71, "teatime": 59, "waldo_kitchen": 22}
"""Number of (frame, category) pairs of LERF-OVS, derived: the smallest counts for which all published
localization figures are whole fractions."""
