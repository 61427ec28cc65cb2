"""The classes of Replica and the evaluated subsets of 48 and 51.

Sources: names and ids from `info_semantic.json` of the release (facebookresearch/Replica-Dataset); the 51
are those of opennerf/opennerf, in its order; the 48 exclude wall, floor and ceiling (aminebdj/OpenYOLO3D),
which matches the paper's number.
"""

from hilsplat.datasets.classes.class_set import ClassSet

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

NAMES: dict[int, str] = dict(enumerate(_TEN_PER_LINE.split(), start=1))
"""Class id -> name as spelt in the release. Negative ids and 0 are undefined."""

# fmt: off
EVALUATED_51: tuple[int, ...] = (
    93, 31, 40, 20, 12, 76, 80, 98, 97, 47, 37, 61, 8, 87, 18, 60, 11, 88, 29, 10, 92, 7, 78, 59,
    44, 34, 26, 54, 71, 91, 63, 3, 64, 52, 62, 56, 35, 95, 13, 15, 22, 70, 83, 17, 82, 65, 14, 19,
    16, 23, 79,
)
# fmt: on
STRUCTURE: tuple[int, ...] = (93, 40, 31)
"""Wall, floor, ceiling."""

SCENES: tuple[str, ...] = (
    *(f"office_{number}" for number in range(5)),
    *(f"room_{number}" for number in range(3)),
)
"""The eight evaluated scenes."""

_QUERIES = {label: name.replace("-", " ") for label, name in NAMES.items()}
"""Class id -> query: hyphens become spaces. OpenYOLO3D keeps them."""

REPLICA_51 = ClassSet.of("replica-51", "OpenNeRF", _QUERIES, EVALUATED_51)
REPLICA_48 = ClassSet.of(
    "replica-48",
    "OpenYOLO3D, paper: without wall, floor, ceiling",
    _QUERIES,
    sorted(set(EVALUATED_51) - set(STRUCTURE)),
)
