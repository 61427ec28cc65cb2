"""Labelled points of a synthetic scene, as in ScanNet, ScanNet200, Replica and Waymo."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from hilsplat.base.artifacts import read_npz
from hilsplat.base.errors import SceneError
from hilsplat.datasets.points.labelled_points import LabelledPoints
from hilsplat.datasets.points.point_files import ply_column, ply_places, read_ply
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.datasets.synthetic.world_points import replica_id, scannet_ids, waymo_labels


def labelled_points(world: Path, kind: str) -> dict[str, LabelledPoints]:
    """Return points with classes by labelling, in the frame of the world's true cameras, metres.

    Args:
        world: output folder of the world stage.
        kind: "room": mesh vertices visible to a camera, because a scanner wouldn't capture the others;
            labellings nyu40, scannet200 and replica. "street": returns of the lidar; labelling waymo.

    Raises:
        SceneError: the world is of a different kind.
        ArtifactError: a file is missing or damaged.
    """
    world = Path(world)
    if kind == "street":
        return {"waymo": _lidar(world)}
    if kind != "room":
        raise SceneError(
            f"a world of kind {kind!r} has no labelled points", expected="room or street", fix="leave it out"
        )
    path = world / "truth" / "mesh.ply"
    mesh = read_ply(path, 3)
    texts = [node.text for node in HierarchyAnnotations.load(world / "truth").nodes]
    seen = ply_column(path, mesh, "vertex", "views") > 0
    whole = ply_column(path, mesh, "vertex", "whole").astype(np.int32)[seen]
    xyz = ply_places(path, mesh)[seen].astype(np.float64)
    ids = [scannet_ids(text) for text in texts]
    instance = (whole + 1).astype(np.int32)
    fine = _of_nodes([fine for fine, _ in ids], whole)
    nyu40 = LabelledPoints(xyz, _of_nodes([broad for _, broad in ids], whole), instance, "nyu40")
    replica = _of_nodes([replica_id(text) for text in texts], whole)
    return {
        "nyu40": nyu40,
        "scannet200": replace(nyu40, class_id=fine, labelling="scannet200"),
        "replica": replace(nyu40, class_id=replica, labelling="replica"),
    }


def _of_nodes(class_of_node: list[int], node: Int32[np.ndarray, " P"]) -> Int32[np.ndarray, " P"]:
    """Return the class of each point's node; 0 for points without a node."""
    return np.array([*class_of_node, 0], dtype=np.int32)[node]


def _lidar(world: Path) -> LabelledPoints:
    scan = read_npz(world / "truth" / "lidar.npz")
    nodes = HierarchyAnnotations.load(world / "truth").nodes
    labels = waymo_labels(scan["node_ids"], [node.text for node in nodes])
    return LabelledPoints(scan["points"].astype(np.float64), labels[:, 1], labels[:, 0], "waymo")
