"""NYU40 labels and the sets of 19, 15 and 10 classes evaluated on ScanNet.

The sets are OpenGaussian's (yanmin-wu/OpenGaussian `scripts/eval_scannet.py`), also listed in the paper.
Labels are those of `<scan>_vh_clean_2.labels.ply`.
"""

from hilsplat.datasets.classes.class_set import ClassSet

NYU40: dict[int, str] = {
    1: "wall",
    2: "floor",
    3: "cabinet",
    4: "bed",
    5: "chair",
    6: "sofa",
    7: "table",
    8: "door",
    9: "window",
    10: "bookshelf",
    11: "picture",
    12: "counter",
    13: "blinds",
    14: "desk",
    15: "shelves",
    16: "curtain",
    17: "dresser",
    18: "pillow",
    19: "mirror",
    20: "floormat",
    21: "clothes",
    22: "ceiling",
    23: "books",
    24: "refrigerator",
    25: "television",
    26: "paper",
    27: "towel",
    28: "shower curtain",
    29: "box",
    30: "whiteboard",
    31: "person",
    32: "nightstand",
    33: "toilet",
    34: "sink",
    35: "lamp",
    36: "bathtub",
    37: "bag",
    38: "otherstructure",
    39: "otherfurniture",
    40: "otherprop",
}
"""NYU40 id -> query. ScanNet's tsv spells 24 `refridgerator`; the paper writes 28 as two words."""

OPENGAUSSIAN_SCENES: tuple[str, ...] = tuple(
    f"scene{number:04d}_00" for number in (0, 62, 70, 97, 140, 200, 347, 400, 590, 645)
)
"""The ten scans of OpenGaussian's table. All but the last are in the train split."""

BENCHMARK_20 = (*range(1, 13), 14, 16, 24, 28, 33, 34, 36, 39)
"""Classes of ScanNet's own benchmark."""


def _classes(name: str, source: str, ids: tuple[int, ...]) -> ClassSet:
    return ClassSet(name, source, ids, tuple(NYU40[label] for label in ids))


SCANNET_19 = _classes(
    "scannet-19", "OpenGaussian, paper: without otherfurniture", tuple(i for i in BENCHMARK_20 if i != 39)
)
SCANNET_15 = _classes(
    "scannet-15",
    "OpenGaussian, paper: without picture, refrigerator, shower curtain, bathtub too",
    tuple(i for i in BENCHMARK_20 if i not in (11, 24, 28, 36, 39)),
)
SCANNET_10 = _classes("scannet-10", "OpenGaussian, paper", (1, 2, 4, 5, 6, 7, 8, 9, 10, 33))
