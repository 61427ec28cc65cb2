"""Labelled points of a synthetic scene, as in ScanNet, ScanNet200, Replica and Waymo."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from hilsplat.base.artifacts import read_npz
from hilsplat.base.errors import SceneError
from hilsplat.datasets.classes import NYU40, REPLICA_NAMES, SCANNET200, WAYMO_22
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.datasets.points.labelled_points import LabelledPoints, PlyMesh

OTHERPROP = 40  # NYU40's class for small objects without a class of their own
SCANNET200_WORDS = {"sofa": "couch", "television": "tv", "bear": "stuffed animal", "mug": "cup"}
REPLICA_WORDS = {
    "bookshelf": "shelf",
    "counter": "countertop",
    "plant": "indoor-plant",
    "television": "tv-screen",
    "toaster": "small-appliance",
    "tv stand": "tv-stand",
    "mug": "cup",
}
"""World class -> its name in the data set, if different. Classes missing from the data set are undefined."""

WAYMO_WORDS = {
    "cyclist": "bicyclist",
    "traffic sign": "sign",
    "street lamp": "pole",
    "tree": "vegetation",
    "bush": "vegetation",
    "ground": "other ground",
    "traffic sign pole": "pole",
    "traffic light pole": "pole",
}
"""Text of a whole or part in a street -> Waymo class name, if different. Fences are undefined, because Waymo
has no class for them."""

COUNTABLE = frozenset({"car", "truck", "bus", "bicyclist", "pedestrian"})  # classes with separate instances


def scannet_ids(text: str) -> tuple[int, int]:
    """Return the ScanNet200 id (0 for none) and NYU40 id of a world class."""
    fine = dict(zip(SCANNET200.texts, SCANNET200.ids, strict=True))
    broad = {query: number for number, query in NYU40.items()}
    return fine.get(SCANNET200_WORDS.get(text, text), 0), broad.get(text, OTHERPROP)


def replica_id(text: str) -> int:
    """Return Replica's class id for a world class, or 0 if there is none."""
    ids = {query: number for number, query in REPLICA_NAMES.items()}
    return ids.get(REPLICA_WORDS.get(text, text), 0)


def waymo_labels(node_ids: Int32[np.ndarray, "P 3"], texts: Sequence[str]) -> Int32[np.ndarray, "P 2"]:
    """Return the instance and Waymo class of each point, from its nodes (whole, part, subpart).

    A part's class overrides that of its whole.
    """
    number = dict(zip(WAYMO_22.texts, WAYMO_22.ids, strict=True))
    of_node = np.array([number.get(WAYMO_WORDS.get(text, text), 0) for text in texts] + [0])
    whole, part = of_node[node_ids[:, 0]], of_node[node_ids[:, 1]]
    classes = np.where(part > 0, part, whole)
    countable = np.isin(classes, [number[name] for name in COUNTABLE])
    return np.stack([np.where(countable, node_ids[:, 0] + 1, 0), classes], axis=1).astype(np.int32)


def labelled_points(world: Path, kind: str) -> dict[str, LabelledPoints]:
    """Return a world's points for each labelling, in metres, in the frame of its ground-truth cameras.

    For a room, these are the mesh vertices visible to a camera (a scanner would miss the others), labelled as
    nyu40, scannet200 and replica. For a street, they are its lidar returns, labelled as waymo.

    Raises:
        SceneError: the world is neither a room nor a street.
        ArtifactError: a file is missing or damaged.
    """
    texts = [node.text for node in HierarchyAnnotations.load(world / "truth").nodes]
    if kind == "street":
        scan = read_npz(world / "truth" / "lidar.npz")
        instance, classes = waymo_labels(scan["node_ids"], texts).T
        return {"waymo": LabelledPoints(scan["points"].astype(np.float64), classes, instance)}
    if kind != "room":
        raise SceneError(
            f"a {kind!r} world has no labelled points", expected="room or street", fix="score its images"
        )
    mesh = PlyMesh(world / "truth" / "mesh.ply", 3, fix="rerun the world stage")
    seen = mesh.column("vertex", "views") > 0
    whole = mesh.column("vertex", "whole").astype(np.int32)[seen]
    xyz = mesh.xyz[seen].astype(np.float64)
    of_node = [(*scannet_ids(text), replica_id(text)) for text in texts] + [(0, 0, 0)]
    fine, broad, of_replica = np.array(of_node, dtype=np.int32).T[:, whole]  # -1, no node, is the last
    nyu40 = LabelledPoints(xyz, broad, whole + 1)
    return {
        "nyu40": nyu40,
        "scannet200": replace(nyu40, class_id=fine),
        "replica": replace(nyu40, class_id=of_replica),
    }
