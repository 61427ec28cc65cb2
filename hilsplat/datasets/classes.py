"""Sets of classes for labelled points: ScanNet (NYU40), ScanNet200, Replica and Waymo."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Int32


@dataclass(frozen=True)
class ClassSet:
    """K classes in a fixed order: label k of a prediction is the class in row k - 1; 0 means no class.

    Attributes:
        name: name of the set, such as `scannet-19`.
        ids: label of each class in the data set's own files.
        texts: query of each class.
    """

    name: str
    ids: tuple[int, ...]
    texts: tuple[str, ...]

    @staticmethod
    def of(name: str, query_of: Mapping[int, str], ids: Iterable[int] | None = None) -> "ClassSet":
        """Return the classes with the given ids (default: all); `query_of` maps ids to the queries."""
        chosen = tuple(query_of if ids is None else ids)
        return ClassSet(name, chosen, tuple(query_of[label] for label in chosen))

    def __len__(self) -> int:
        return len(self.ids)

    def labels(self, file_labels: Int[np.ndarray, " P"]) -> Int32[np.ndarray, " P"]:
        """Map the data set's point labels to 1 .. K, or to 0 if their class is not in the set."""
        order = np.argsort(self.ids)
        known = np.asarray(self.ids)[order]
        place = np.minimum(np.searchsorted(known, file_labels), len(known) - 1)
        return np.where(known[place] == file_labels, order[place] + 1, 0).astype(np.int32)


def words_of(listed: str) -> list[str]:
    """Split a comma-separated list, which may have line breaks."""
    return [" ".join(word.split()) for word in listed.split(",")]


_NYU40 = """
    wall, floor, cabinet, bed, chair, sofa, table, door, window, bookshelf, picture, counter, blinds, desk,
    shelves, curtain, dresser, pillow, mirror, floormat, clothes, ceiling, books, refrigerator, television,
    paper, towel, shower curtain, box, whiteboard, person, nightstand, toilet, sink, lamp, bathtub, bag,
    otherstructure, otherfurniture, otherprop
"""
NYU40: dict[int, str] = dict(enumerate(words_of(_NYU40), start=1))
"""NYU40 id, as in `<scan>_vh_clean_2.labels.ply` -> query. ScanNet's tsv spells class 24 `refridgerator`;
the paper writes class 28 as two words."""

# The sets of 19, 15 and 10 classes are those of yanmin-wu/OpenGaussian `scripts/eval_scannet.py` and of the
# paper. The 19 are the 20 of ScanNet's own benchmark without otherfurniture (39); the 15 also omit picture,
# refrigerator, shower curtain and bathtub.
SCANNET_19 = ClassSet.of("scannet-19", NYU40, [*range(1, 13), 14, 16, 24, 28, 33, 34, 36])
SCANNET_15 = ClassSet.of("scannet-15", NYU40, [n for n in SCANNET_19.ids if n not in (11, 24, 28, 36)])
SCANNET_10 = ClassSet.of("scannet-10", NYU40, [1, 2, 4, 5, 6, 7, 8, 9, 10, 33])

SPLITS: dict[str, str] = {
    "head": """
        1 wall, 2 chair, 3 floor, 4 table, 5 door, 6 couch, 7 cabinet, 8 shelf, 9 desk, 10 office chair,
        11 bed, 13 pillow, 14 sink, 15 picture, 16 window, 17 toilet, 18 bookshelf, 19 monitor, 21 curtain,
        22 book, 23 armchair, 24 coffee table, 26 box, 27 refrigerator, 28 lamp, 29 kitchen cabinet,
        31 towel, 32 clothes, 33 tv, 34 nightstand, 35 counter, 36 dresser, 38 stool, 40 plant, 41 ceiling,
        42 bathtub, 48 backpack, 51 tv stand, 52 whiteboard, 55 shower curtain, 56 trash can, 57 closet,
        58 stairs, 62 stove, 69 board, 70 washing machine, 71 mirror, 72 copier, 74 sofa chair,
        75 file cabinet, 78 shower, 86 blinds, 89 blackboard, 96 radiator, 97 recycling bin, 99 wardrobe,
        110 clothes dryer, 125 bathroom stall, 128 shower wall, 159 kitchen counter, 161 doorframe,
        540 mailbox, 1163 object, 1164 bathroom vanity, 1165 closet wall, 1171 stair rail
    """,
    "common": """
        39 cushion, 44 end table, 45 dining table, 46 keyboard, 47 bag, 49 toilet paper, 50 printer,
        54 blanket, 59 microwave, 63 shoe, 64 computer tower, 65 bottle, 66 bin, 67 ottoman, 68 bench,
        73 basket, 76 fan, 77 laptop, 80 person, 82 paper towel dispenser, 84 oven, 87 rack, 90 piano,
        93 suitcase, 95 rail, 98 container, 101 telephone, 104 stand, 105 light, 106 laundry basket,
        107 pipe, 116 seat, 120 column, 121 bicycle, 122 ladder, 131 jacket, 132 storage bin,
        134 coffee maker, 136 dishwasher, 139 machine, 140 mat, 141 windowsill, 154 bulletin board,
        156 fireplace, 165 mini fridge, 177 water cooler, 188 shower door, 191 pillar, 193 ledge,
        213 furniture, 214 cart, 250 decoration, 276 closet door, 283 vacuum cleaner, 323 dish rack,
        342 range hood, 609 projector screen, 748 divider, 1156 bathroom counter, 1166 laundry hamper,
        1167 bathroom stall door, 1168 ceiling light, 1169 trash bin, 1173 bathroom cabinet, 1178 structure,
        1183 storage organizer, 1189 potted plant, 1191 mattress
    """,
    "tail": """
        79 paper, 88 plate, 100 soap dispenser, 102 bucket, 103 clock, 112 guitar, 115 toilet paper holder,
        118 speaker, 130 cup, 138 paper towel roll, 145 bar, 148 toaster, 155 ironing board, 157 soap dish,
        163 toilet paper dispenser, 166 fire extinguisher, 168 ball, 169 hat, 170 shower curtain rod,
        180 paper cutter, 185 tray, 195 toaster oven, 202 mouse, 208 toilet seat cover dispenser,
        221 storage container, 229 scale, 230 tissue box, 232 light switch, 233 crate, 242 power outlet,
        261 sign, 264 projector, 286 candle, 300 plunger, 304 stuffed animal, 312 headphones, 325 broom,
        331 guitar case, 356 dustpan, 370 hair dryer, 392 water bottle, 395 handicap bar, 399 purse,
        408 vent, 417 shower floor, 488 water pitcher, 562 bowl, 570 paper bag, 572 alarm clock,
        581 music stand, 776 laundry detergent, 1170 dumbbell, 1172 tube, 1174 cd case, 1175 closet rod,
        1176 coffee kettle, 1179 shower head, 1180 keyboard piano, 1181 case of water bottles,
        1182 coat rack, 1184 folded chair, 1185 fire alarm, 1186 power strip, 1187 calendar, 1188 poster,
        1190 luggage
    """,
}
"""Id and name of each class, by split: 66 head, 68 common, 66 tail.

Source: ScanNet/ScanNet `BenchmarkScripts/ScanNet200`. Ids, up to 1191, are those in the `id` column of
`scannetv2-labels.combined.tsv`; several raw categories may share an id.
"""

_ENTRIES = [(split, entry.split(" ", 1)) for split, listed in SPLITS.items() for entry in words_of(listed)]
CLASSES = tuple(sorted((int(label), name, split) for split, (label, name) in _ENTRIES))
"""Id, name and split of each class, in the benchmark's order (by id)."""
_NAMES = {label: name for label, name, _ in CLASSES}

SCANNET200 = ClassSet.of("scannet200", _NAMES)
_WITH_INSTANCES = [label for label, name in _NAMES.items() if name not in ("wall", "floor")]
SCANNET200_INSTANCES = ClassSet.of("scannet200-instances", _NAMES, _WITH_INSTANCES)


def splits_of(classes: ClassSet) -> dict[str, tuple[bool, ...]]:
    """Return, by split, whether each class of a set belongs to that split, in the set's order."""
    split_of = {label: split for label, _, split in CLASSES}
    return {split: tuple(split_of[label] == split for label in classes.ids) for split in SPLITS}


_TEN_PER_LINE = """
    backpack base-cabinet basket bathtub beam beanbag bed bench bike bin
    blanket blinds book bottle box bowl camera cabinet candle chair
    chopping-board clock cloth clothing coaster comforter computer-keyboard cup cushion curtain
    ceiling cooktop countertop desk desk-organizer desktop-computer door exercise-ball faucet floor
    handbag hair-dryer handrail indoor-plant knife-block kitchen-utensil lamp laptop major-appliance mat
    microwave monitor mouse nightstand pan panel paper-towel phone picture pillar
    pillow pipe plant-stand plate pot rack refrigerator remote-control scarf sculpture
    shelf shoe shower-stall sink small-appliance sofa stair stool switch table
    table-runner tablet tissue-paper toilet toothbrush towel tv-screen tv-stand umbrella utensil-holder
    vase vent wall wall-cabinet wall-plug wardrobe window rug logo bag
    set-of-clothing
"""
REPLICA_NAMES: dict[int, str] = dict(enumerate(_TEN_PER_LINE.split(), start=1))
"""Class id -> name as spelt in the release. Negative ids and 0 are undefined.

Source: `info_semantic.json` of the release (facebookresearch/Replica-Dataset).
"""

REPLICA_EVALUATED_51 = (
    93, 31, 40, 20, 12, 76, 80, 98, 97, 47, 37, 61, 8, 87, 18, 60, 11, 88, 29, 10, 92, 7, 78, 59,
    44, 34, 26, 54, 71, 91, 63, 3, 64, 52, 62, 56, 35, 95, 13, 15, 22, 70, 83, 17, 82, 65, 14, 19,
    16, 23, 79,
)  # fmt: skip
"""The 51 classes of opennerf/opennerf, in that repository's order."""

_QUERIES = {label: name.replace("-", " ") for label, name in REPLICA_NAMES.items()}
"""Class id -> query: hyphens become spaces. OpenYOLO3D keeps hyphens."""

REPLICA_51 = ClassSet.of("replica-51", _QUERIES, REPLICA_EVALUATED_51)
# The 48 classes of aminebdj/OpenYOLO3D omit wall, floor and ceiling; the paper states the same number.
REPLICA_48 = ClassSet.of("replica-48", _QUERIES, sorted(set(REPLICA_EVALUATED_51) - {93, 40, 31}))

_WAYMO = """
    car, truck, bus, other vehicle, motorcyclist, bicyclist, pedestrian, sign, traffic light, pole,
    construction cone, bicycle, motorcycle, building, vegetation, tree trunk, curb, road, lane marker,
    other ground, walkable ground, sidewalk
"""
WAYMO_22 = ClassSet.of("waymo-22", dict(enumerate(words_of(_WAYMO), start=1)))
"""The 22 classes of Waymo's 3D semantic segmentation; 0 is undefined.

Source: waymo-research/waymo-open-dataset `protos/segmentation.proto`. The benchmark has no text queries, so
the queries are ours: the class names in plain words, and "walkable ground" for TYPE_WALKABLE.
"""

LABELLINGS: dict[str, tuple[ClassSet, ...]] = {
    "nyu40": (SCANNET_19, SCANNET_15, SCANNET_10),
    "scannet200": (SCANNET200, SCANNET200_INSTANCES),
    "replica": (REPLICA_51, REPLICA_48),
    "waymo": (WAYMO_22,),
}
"""Labelling (meaning of the class ids in a data set's files) -> class sets evaluated on it."""
