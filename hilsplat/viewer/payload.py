"""Data for the page: scene, nodes, answers and boxes as JSON, and the Gaussians' order and nodes."""

import gzip
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64
from typing_extensions import TypedDict  # pydantic needs this class before Python 3.12

from hilsplat.base.levels import LEVELS, path_of
from hilsplat.query.hits import Hit, NodeGroup, doubts_of
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.scene_views import upright
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.tree import OrientedBox, SemanticTree
from hilsplat.splat.gaussians import Gaussians, morton_order
from hilsplat.viewer.wire import Question
from hilsplat.web.server import view_name

CHUNK = 65_536  # Gaussians per chunk: 16 rows of the page's textures
ALIKE = 24  # maximum number of similar nodes in an answer


def arrival_order(gaussians: Gaussians) -> Int64[np.ndarray, " N"]:
    """Return the order in which the page loads Gaussians: most visible first, in Morton order within chunks.

    The first chunk alone gives an impression of the scene.
    """
    scales = np.sort(gaussians.log_scales, axis=1)
    shows = np.argsort(-(scales[:, 1] + scales[:, 2] + np.log(gaussians.opacities + 1e-12)), kind="stable")
    chunks = [shows[first : first + CHUNK] for first in range(0, len(shows), CHUNK)]
    return np.concatenate([chunk[morton_order(gaussians.means[chunk])] for chunk in chunks])


def packed_nodes(tree: SemanticTree, order: Int64[np.ndarray, " N"]) -> bytes:
    """Return gzipped RGBA texels: one node per Gaussian and level, numbered from 1, or 0 if none.

    A number has 16 bits or, if these are too few, 32; the page distinguishes them by the number of bytes.
    """
    texels = np.zeros((len(order), 4), np.uint16 if len(tree) <= np.iinfo(np.uint16).max else np.uint32)
    texels[:, :3] = tree.node_of_gaussian[order] + 1
    return gzip.compress(texels.tobytes(), 1, mtime=0)


def described_scene(scene: Scene, gaussians: Gaussians) -> dict[str, Any]:
    """Describe the scene: views with their cameras, initial focus point, and up direction."""
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
            {"name": name, "split": scene.split[name], **described_camera(cameras[name])}
            for name in cameras.names
        ],
    }


def described_camera(camera: Camera) -> dict[str, Any]:
    """Describe a camera in the format of `wire.WireCamera`."""
    pose, K = camera.cam_from_world.tolist(), camera.K.tolist()
    return {"cam_from_world": pose, "K": K, "size_hw": list(camera.size_hw)}


def crossing(cameras: Cameras) -> Float64[np.ndarray, " 3"]:
    """Return the point nearest to all optical axes (least squares), in front of the first camera.

    A small pull towards a point in front of the mean camera makes the result unique for parallel axes.
    """
    rotation, translation = cameras.cam_from_world[:, :3, :3], cameras.cam_from_world[:, :3, 3]
    centres = -np.einsum("vji,vj->vi", rotation, translation)
    ahead = rotation[:, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()) or 1.0
    guess = (centres + spread * ahead).mean(axis=0)
    pull = 1e-3 * len(centres)
    focus = np.linalg.solve(
        across.sum(axis=0) + pull * np.eye(3), np.einsum("vij,vj->i", across, centres) + pull * guess
    )
    return focus if (focus - centres[0]) @ ahead[0] > 0 else guess


def described_nodes(scene: LanguageScene) -> dict[str, Any]:
    """Describe the nodes for the page's outline: one entry per node, in row order."""
    tree, names, naming = scene.tree, scene.names, scene.naming
    has_names = naming is not None and any(naming.of_node)
    members = np.bincount(tree.node_of_gaussian.ravel() + 1, minlength=len(tree) + 1)[1:]
    corners = box_corners(tree.oriented_box)
    return {
        "version": names.version,
        "levels": [level.label for level in LEVELS],
        "nodes": [
            {
                "level": int(tree.level[node]) - 1,
                "parent": int(tree.parent[node]),
                "name": names.of_node.get(node, ""),
                "called": naming.of_node[node] or "?" if naming is not None and has_names else "",
                "surface": naming is not None and naming.surfaces[node],
                "gaussians": int(members[node]),
                "views": int(tree.views[node]),
                "corners": corners[node],
                "size": [round(value, 5) for value in tree.oriented_box[node][4].tolist()],
            }
            for node in range(len(tree))
        ],
    }


def box_corners(rows: Float32[np.ndarray, "n 5 3"]) -> list[list[list[float]]]:
    """Return the eight corners of each stored oriented box (`OrientedBox.corners`, many at once)."""
    unit = OrientedBox.from_array(np.vstack([np.zeros(3), np.eye(3), np.ones(3)])).corners()
    boxes = rows.astype(np.float64)
    return np.round(boxes[:, :1] + (unit * boxes[:, 4:]) @ boxes[:, 1:4], 5).tolist()


class FoundNode(TypedDict):
    """One answer; `node` is a row of the semantic tree."""

    node: int
    level: str
    score: float
    name: str


class Answer(TypedDict):
    """Answers to a text, or nodes that look like a node or a picture.

    `relevancy` has one value per node, `hits` are all answers, best first; `best_views` show the first one,
    numbered in camera order; `route` is as in `Hit`.
    """

    text: str
    level: str
    hits: list[FoundNode]
    best_views: list[int]
    relevancy: list[float]
    doubts: list[str]
    caution: str
    route: str


def answer(scene: LanguageScene, asked: Question, answerer: str = "tree") -> Answer:
    """Query a scene; return hits, each node's relevancy to the last text, and doubts.

    Raises:
        SettingsError: the text is empty, or the view does not exist.
    """
    view = None if asked.view is None else view_name(scene.scene, asked.view)
    nodes = scene.select(
        asked.text, level=asked.level, answerer=answerer, view=view, threshold=asked.threshold
    )
    relevancy = scene.node_relevancy(path_of(asked.text)[-1:], answerer)[0]
    found = nodes.ids.tolist(), scene.scores_of(nodes), scene.hits_of(nodes, 1)
    return {
        **_answer(scene, asked.text, *found, relevancy),
        "level": nodes.level.label,
        "doubts": [str(doubt) for doubt in doubts_of(nodes)],
        "caution": scene.caution_about(asked.text),
        "route": nodes.route,
    }


def alike(scene: LanguageScene, hits: Sequence[Hit], what: str, also: Sequence[int] = ()) -> Answer:
    """Return nodes that look like a node or picture, as an answer; nodes in `also` get relevancy 1."""
    relevancy = np.zeros(len(scene.tree))
    nodes, scores = [hit.node for hit in hits], [hit.score for hit in hits]
    relevancy[nodes] = np.maximum(scores, 0.0)
    relevancy[list(also)] = 1
    return _answer(scene, what, nodes, scores, hits, relevancy)


def _answer(
    scene: LanguageScene,
    text: str,
    nodes: Sequence[int],
    scores: Sequence[float],
    first: Sequence[Hit],
    relevancy: np.ndarray,
) -> Answer:
    """Return an answer; `first` has at least the first hit, since all of tens of thousands take seconds."""
    labels = [LEVELS[level - 1].label for level in scene.tree.level[list(nodes)]]
    return {
        "text": text,
        "level": labels[0] if labels else "",
        "hits": [
            {"node": node, "level": level, "score": round(score, 4), "name": scene.name_of(node)}
            for node, level, score in zip(nodes, labels, scores, strict=True)
        ],
        "best_views": [scene.views.names.index(view) for hit in first[:1] for view in hit.best_views],
        "relevancy": np.round(relevancy, 4).tolist(),
        "doubts": [],
        "caution": "",
        "route": "like",
    }


def boxes(scene: LanguageScene, groups: Sequence[NodeGroup]) -> dict[str, Any]:
    """Return node boxes for other programs; a node in several groups has one box per group."""
    tree = scene.tree
    return {
        "format": "hilsplat-boxes-1",
        "scene": scene.scene.name,
        "unit": scene.scene.unit,
        "axes": "right-handed; cameras in OpenCV axes (x right, y down, z forward)",
        "scene_from_source": scene.scene.scene_from_source.tolist(),
        "boxes": [
            {
                "group": group.name,
                "node": node,
                "name": scene.name_of(node),
                "score": score,
                "doubts": group.doubts,
                "level": int(tree.level[node]),
                "parent": int(tree.parent[node]),
                "centre": tree.oriented_box[node][0].tolist(),
                "axes": tree.oriented_box[node][1:4].tolist(),
                "size": tree.oriented_box[node][4].tolist(),
                "corners": box_corners(tree.oriented_box[[node]])[0],
                "lower": tree.box[node][0].tolist(),
                "upper": tree.box[node][1].tolist(),
                "centroid": tree.centroid[node].tolist(),
            }
            for group in groups
            for node, score in group.score_of.items()
        ],
    }
