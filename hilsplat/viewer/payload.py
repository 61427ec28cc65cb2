"""What the page gets once: the scene as JSON, Gaussians and their nodes as bytes for the GPU."""

import struct
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from hilsplat.base.levels import LEVELS, Level
from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.boxes import OrientedBox
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.splat.gaussians import Gaussians

MAGIC = b"hilsplat"
HEADER = struct.Struct("<8sIII12x")
"""Magic, number of Gaussians, number of spherical harmonics, texels of harmonics a Gaussian; 32 bytes."""

HALVES_PER_TEXEL = 8
MAX_NODES = 65_534
"""Nodes are numbered from 1 in 16 bits; 0 is none."""

LARGEST_LOG_SCALE = 20.0
"""As the rasteriser cuts scales."""


def packed_gaussians(gaussians: Gaussians) -> bytes:
    """Header, two texels of geometry per Gaussian, then its harmonics; texels are RGBA32UI.

    Geometry: mean (3 floats) and opacity (float); log scales, a spare and the unit quaternion (8 halves).
    Halves hold the logarithm of a scale: a relative error of 0.4 % at most for scales from 1e-4 to 1e4.
    """
    n, bases = len(gaussians), gaussians.sh.shape[1]
    texels = -(-3 * bases // HALVES_PER_TEXEL)
    geometry = np.zeros((n, 8), np.float32)
    geometry[:, :3], geometry[:, 3] = gaussians.means, gaussians.opacities
    halves = np.zeros((n, 8), np.float16)
    halves[:, :3] = np.minimum(gaussians.log_scales, LARGEST_LOG_SCALE)
    halves[:, 4:] = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    geometry[:, 4:] = halves.view(np.float32)
    harmonics = np.zeros((n, texels * HALVES_PER_TEXEL), np.float16)
    harmonics[:, : 3 * bases] = gaussians.sh.reshape(n, -1)
    return b"".join((HEADER.pack(MAGIC, n, bases, texels), geometry.tobytes(), harmonics.tobytes()))


def packed_nodes(tree: SemanticTree) -> bytes:
    """RGBA16UI texel per Gaussian: its node at each level, from 1; 0 is none. The fourth channel is spare."""
    assert len(tree) <= MAX_NODES, f"{len(tree)} nodes"
    texels = np.zeros((len(tree.node_of_gaussian), 4), np.uint16)
    texels[:, :3] = tree.node_of_gaussian + 1
    return texels.tobytes()


def described_scene(scene: Scene, gaussians: Gaussians) -> dict[str, Any]:
    """Views with their cameras, and where a visitor stands: what to look at, and which way is up."""
    cameras = scene.cameras
    up, focus = upright(cameras), crossing(cameras)
    centres = np.stack([cameras[name].centre for name in cameras.names])
    return {
        "name": scene.name,
        "unit": "metre" if scene.unit == "metre" else "scene unit",
        "gaussians": len(gaussians),
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
    """Mean of the directions that are up in the photographs."""
    up = -cameras.cam_from_world[:, 1, :3].mean(axis=0)
    length = np.linalg.norm(up)
    return up / length if length > 1e-6 else -cameras.cam_from_world[0, 1, :3]


def crossing(cameras: Cameras) -> Float64[np.ndarray, " 3"]:
    """The point nearest to all optical axes in the least-squares sense, kept in front of the first camera.

    Parallel axes have no such point: a small pull towards one unit ahead of the mean camera decides then.
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
    """The outline: one entry per node, in row order."""
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
    """The eight corners of a stored oriented box."""
    return np.round(OrientedBox.from_array(rows).corners(), 5).tolist()


def as_steps(relevancy: np.ndarray) -> UInt8[np.ndarray, " N"]:
    """Relevancies in [0, 1] as bytes."""
    return (np.clip(relevancy, 0, 1) * 255 + 0.5).astype(np.uint8)
