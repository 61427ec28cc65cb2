"""Names that ScanNet, Replica and Waymo use for the objects of a synthetic room or street."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int32

from hilsplat.datasets.classes import replica, scannet, scannet200, waymo

OTHERPROP = 40
"""NYU40's class for small objects without a class of their own."""
SCANNET200_NAMES = {"sofa": "couch", "television": "tv", "bear": "stuffed animal", "mug": "cup"}
REPLICA_NAMES = {
    "bookshelf": "shelf",
    "counter": "countertop",
    "plant": "indoor-plant",
    "television": "tv-screen",
    "toaster": "small-appliance",
    "tv stand": "tv-stand",
    "mug": "cup",
}
"""Classes of the world -> names in the data set, if different. Classes that it lacks are undefined there."""

WAYMO_CLASSES: dict[str, str] = {
    "car": "car",
    "truck": "truck",
    "bus": "bus",
    "cyclist": "bicyclist",
    "pedestrian": "pedestrian",
    "traffic sign": "sign",
    "traffic light": "traffic light",
    "street lamp": "pole",
    "building": "building",
    "tree": "vegetation",
    "bush": "vegetation",
    "curb": "curb",
    "road": "road",
    "lane marker": "lane marker",
    "sidewalk": "sidewalk",
    "ground": "other ground",
    "tree trunk": "tree trunk",
    "traffic sign pole": "pole",
    "traffic light pole": "pole",
}
"""Text of a whole or part of a street -> Waymo class name; a part's class overrides its whole's. Fences are
undefined: Waymo has no class for them."""

COUNTABLE = frozenset({"car", "truck", "bus", "bicyclist", "pedestrian"})
"""Classes with separate instances."""


def scannet_ids(text: str) -> tuple[int, int]:
    """Return the ScanNet200 id (0 for none) and NYU40 id of a class of the world."""
    name = SCANNET200_NAMES.get(text, text)
    fine = dict(zip(scannet200.SCANNET200.texts, scannet200.SCANNET200.ids, strict=True))
    broad = {query: number for number, query in scannet.NYU40.items()}
    return fine.get(name, 0), broad.get(text, OTHERPROP)


def replica_id(text: str) -> int:
    """Return Replica's class id of a class of the world, 0 for none."""
    name = REPLICA_NAMES.get(text, text)
    return {query: number for number, query in replica.NAMES.items()}.get(name, 0)


def waymo_labels(node_ids: Int32[np.ndarray, "P 3"], texts: Sequence[str]) -> Int32[np.ndarray, "P 2"]:
    """Return instance and Waymo class of points, from their nodes (whole, part, subpart)."""
    number = {query: label for label, _, query in waymo.CLASSES}
    of_node = np.array([number.get(WAYMO_CLASSES.get(text, ""), 0) for text in texts] + [0])
    whole, part = of_node[node_ids[:, 0]], of_node[node_ids[:, 1]]
    classes = np.where(part > 0, part, whole)
    countable = np.isin(classes, [number[name] for name in COUNTABLE])
    return np.stack([np.where(countable, node_ids[:, 0] + 1, 0), classes], axis=1).astype(np.int32)
