"""NYU40 labels and the sets of 19, 15 and 10 classes evaluated on ScanNet.

The sets are OpenGaussian's (yanmin-wu/OpenGaussian `scripts/eval_scannet.py`), also listed in the paper.
Labels are those of `<scan>_vh_clean_2.labels.ply`.
"""

from hilsplat.datasets.classes.class_set import ClassSet, words_of

_NAMES = """
    wall, floor, cabinet, bed, chair, sofa, table, door, window, bookshelf, picture, counter, blinds, desk,
    shelves, curtain, dresser, pillow, mirror, floormat, clothes, ceiling, books, refrigerator, television,
    paper, towel, shower curtain, box, whiteboard, person, nightstand, toilet, sink, lamp, bathtub, bag,
    otherstructure, otherfurniture, otherprop
"""

NYU40: dict[int, str] = dict(enumerate(words_of(_NAMES), start=1))
"""NYU40 id -> query. ScanNet's tsv spells 24 `refridgerator`; the paper writes 28 as two words."""

OPENGAUSSIAN_SCENES: tuple[str, ...] = tuple(
    f"scene{number:04d}_00" for number in (0, 62, 70, 97, 140, 200, 347, 400, 590, 645)
)
"""The ten scans of OpenGaussian's table. All but the last are in the training split."""

BENCHMARK_20 = (*range(1, 13), 14, 16, 24, 28, 33, 34, 36, 39)
"""Classes of ScanNet's own benchmark."""

SCANNET_19 = ClassSet.of(
    "scannet-19",
    "OpenGaussian, paper: without otherfurniture",
    NYU40,
    [label for label in BENCHMARK_20 if label != 39],
)
SCANNET_15 = ClassSet.of(
    "scannet-15",
    "OpenGaussian, paper: without picture, refrigerator, shower curtain, bathtub too",
    NYU40,
    [label for label in BENCHMARK_20 if label not in (11, 24, 28, 36, 39)],
)
SCANNET_10 = ClassSet.of("scannet-10", "OpenGaussian, paper", NYU40, [1, 2, 4, 5, 6, 7, 8, 9, 10, 33])
