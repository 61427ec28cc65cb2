"""Sets of classes for labelled points, from `classes.json`: ScanNet (NYU40), ScanNet200, Replica, Waymo."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int, Int32


@dataclass(frozen=True)
class ClassSet:
    """K classes in a fixed order: label k of a prediction is the class in row k - 1; 0 means no class."""

    name: str  # such as `scannet-19`
    ids: tuple[int, ...]  # label of each class in the data set's own files
    texts: tuple[str, ...]  # query of each class

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
        ids = np.asarray(self.ids)[order]
        index = np.minimum(np.searchsorted(ids, file_labels), len(ids) - 1)
        return np.where(ids[index] == file_labels, order[index] + 1, 0).astype(np.int32)


_LISTS = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))

NYU40: dict[int, str] = dict(enumerate(_LISTS["nyu40"], start=1))
"""NYU40 id, as in `<scan>_vh_clean_2.labels.ply` -> query. ScanNet's tsv spells class 24 `refridgerator`;
the paper writes class 28 as two words."""

# The sets of 19, 15 and 10 classes are those of yanmin-wu/OpenGaussian `scripts/eval_scannet.py` and of the
# paper. The 19 are the 20 of ScanNet's own benchmark without otherfurniture (39); the 15 also omit picture,
# refrigerator, shower curtain and bathtub.
SCANNET_19 = ClassSet.of("scannet-19", NYU40, [*range(1, 13), 14, 16, 24, 28, 33, 34, 36])
SCANNET_15 = ClassSet.of("scannet-15", NYU40, [n for n in SCANNET_19.ids if n not in (11, 24, 28, 36)])
SCANNET_10 = ClassSet.of("scannet-10", NYU40, [1, 2, 4, 5, 6, 7, 8, 9, 10, 33])

SPLITS: dict[str, dict[str, str]] = _LISTS["scannet200"]
"""Id and name of each class, by split: 66 head, 68 common, 66 tail.

Source: ScanNet/ScanNet `BenchmarkScripts/ScanNet200`. Ids, up to 1191, are those in the `id` column of
`scannetv2-labels.combined.tsv`; several raw categories may share an id.
"""

CLASSES = tuple(sorted((int(n), name, split) for split, of in SPLITS.items() for n, name in of.items()))
"""Id, name and split of each class, in the benchmark's order (by id)."""
_NAMES = {label: name for label, name, _ in CLASSES}

SCANNET200 = ClassSet.of("scannet200", _NAMES)
_WITH_INSTANCES = [label for label, name in _NAMES.items() if name not in ("wall", "floor")]
SCANNET200_INSTANCES = ClassSet.of("scannet200-instances", _NAMES, _WITH_INSTANCES)


def splits_of(classes: ClassSet) -> dict[str, tuple[bool, ...]]:
    """Return, by split, whether each class of a set belongs to that split, in the set's order."""
    split_of = {label: split for label, _, split in CLASSES}
    return {split: tuple(split_of[label] == split for label in classes.ids) for split in SPLITS}


REPLICA_NAMES: dict[int, str] = dict(enumerate(_LISTS["replica"], start=1))
"""Class id -> name as spelt in the release. Negative ids and 0 are undefined.

Source: `info_semantic.json` of the release (facebookresearch/Replica-Dataset).
"""

REPLICA_EVALUATED_51: tuple[int, ...] = tuple(_LISTS["replica_51"])
"""The 51 classes of opennerf/opennerf, in that repository's order."""

_QUERIES = {label: name.replace("-", " ") for label, name in REPLICA_NAMES.items()}
"""Class id -> query: hyphens become spaces. OpenYOLO3D keeps hyphens."""

REPLICA_51 = ClassSet.of("replica-51", _QUERIES, REPLICA_EVALUATED_51)
# The 48 classes of aminebdj/OpenYOLO3D omit wall, floor and ceiling; the paper states the same number.
REPLICA_48 = ClassSet.of("replica-48", _QUERIES, sorted(set(REPLICA_EVALUATED_51) - {93, 40, 31}))

WAYMO_22 = ClassSet.of("waymo-22", dict(enumerate(_LISTS["waymo"], start=1)))
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
