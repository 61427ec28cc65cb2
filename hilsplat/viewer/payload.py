"""Data that the page loads once: the scene as JSON, Gaussians in chunks, and their nodes."""

import gzip
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from hilsplat.base.levels import LEVELS, Level
from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.boxes import OrientedBox
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.splat.gaussians import Gaussians, morton_order

CHUNK = 65_536
"""Gaussians per chunk: 32 rows of the page's textures."""

MAX_NODES = 65_534
"""Maximum number of nodes, which are numbered from 1 in 16 bits; 0 is none."""


def arrival_order(gaussians: Gaussians) -> Int64[np.ndarray, " N"]:
    """Return the order in which the page loads Gaussians: most visible first, chunks in Morton order.

    The first chunk alone shows the outline of the scene.
    """
    scales = np.sort(gaussians.log_scales, axis=1)
    shows = np.argsort(-(scales[:, 1] + scales[:, 2] + np.log(gaussians.opacities + 1e-12)), kind="stable")
    chunks = [shows[first : first + CHUNK] for first in range(0, len(shows), CHUNK)]
    return np.concatenate([chunk[morton_order(gaussians.means[chunk])] for chunk in chunks])


def packed_nodes(tree: SemanticTree, order: Int64[np.ndarray, " N"]) -> bytes:
    """Pack each Gaussian's nodes (from 1; 0 is none) as a gzipped RGBA16UI texel, one level per channel."""
    assert len(tree) <= MAX_NODES, f"{len(tree)} nodes"
    texels = np.zeros((len(order), 4), np.uint16)
    texels[:, :3] = tree.node_of_gaussian[order] + 1
    return gzip.compress(texels.tobytes(), 1, mtime=0)


def described_scene(scene: Scene, gaussians: Gaussians) -> dict[str, Any]:
    """Describe the scene: views with their cameras, the initial focus point and the up direction."""
    cameras = scene.cameras
    up, focus = upright(cameras), crossing(cameras)
    centres = np.stack([cameras[name].centre for name in cameras.names])
    return {
        "name": scene.name,
        "unit": "metre" if scene.unit == "metre" else "scene unit",
        "gaussians": len(gaussians),
        "chunk": CHUNK,
        "sh_degree": gaussians.sh_degree,
        "up": up.tolist(),
        "focus": focus.tolist(),
        "reach": float(np.linalg.norm(centres - focus, axis=1).mean()),
        "views": [
            {
                "name": name,
                "split": scene.split[name],
                "size_hw": list(cameras[name].size_hw),
                "K": cameras[name].K.tolist(),
                "cam_from_world": cameras[name].cam_from_world.tolist(),
            }
            for name in cameras.names
        ],
    }


def upright(cameras: Cameras) -> Float64[np.ndarray, " 3"]:
    """Return the mean up direction of the photographs."""
    up = -cameras.cam_from_world[:, 1, :3].mean(axis=0)
    length = np.linalg.norm(up)
    return up / length if length > 1e-6 else -cameras.cam_from_world[0, 1, :3]


def crossing(cameras: Cameras) -> Float64[np.ndarray, " 3"]:
    """Return the point nearest to all optical axes (least squares), in front of the first camera.

    Parallel axes have no such point, so a small pull towards a point ahead of the mean camera decides.
    """
    rotation, translation = cameras.cam_from_world[:, :3, :3], cameras.cam_from_world[:, :3, 3]
    centres = -np.einsum("vji,vj->vi", rotation, translation)
    ahead = rotation[:, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()) or 1.0
    guess = (centres + spread * ahead).mean(axis=0)
    pull = 1e-3 * len(centres)
    found = np.linalg.solve(
        across.sum(axis=0) + pull * np.eye(3), np.einsum("vij,vj->i", across, centres) + pull * guess
    )
    return found if (found - centres[0]) @ ahead[0] > 0 else guess


def described_nodes(scene: LanguageScene) -> dict[str, Any]:
    """Describe the outline: one entry per node, in row order."""
    tree, names, naming = scene.tree, scene.names, scene.naming
    members = [np.bincount(column[column >= 0], minlength=len(tree)) for column in tree.node_of_gaussian.T]
    return {
        "version": names.version,
        "levels": [level.label for level in LEVELS],
        "nodes": [
            {
                "level": int(tree.level[node]) - 1,
                "parent": int(tree.parent[node]),
                "name": names.of_node.get(node, ""),
                "called": "" if naming is None else naming.of_node[node] or "?",
                "surface": naming is not None and naming.surfaces[node],
                "gaussians": int(members[Level(int(tree.level[node])).index][node]),
                "views": int(tree.views[node]),
                "quality": round(float(tree.quality[node]), 3),
                "centroid": [round(value, 5) for value in tree.centroid[node].tolist()],
                "corners": box_corners(tree.oriented_box[node]),
                "size": [round(value, 5) for value in tree.oriented_box[node][4].tolist()],
                "best_view": tree.view_names[int(tree.view_area_px[node].argmax())],
            }
            for node in range(len(tree))
        ],
    }


def box_corners(rows: np.ndarray) -> list[list[float]]:
    """Return the eight corners of a stored oriented box."""
    return np.round(OrientedBox.from_array(rows).corners(), 5).tolist()
