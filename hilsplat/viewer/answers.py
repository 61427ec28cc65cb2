"""Answers in the format of the page: hits, relevancy of every node, doubts, boxes."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from hilsplat.query.hits import Hit, doubts_of
from hilsplat.query.language_scene import LanguageScene, path_of
from hilsplat.viewer.payload import box_corners
from hilsplat.viewer.wire import Group, Question
from hilsplat.web.server import view_name

LISTED = 24
"""Maximum number of answers in the list."""


class FoundNode(TypedDict):
    """One answer: row of the semantic tree, level, score, name, numbers of the views that show it largest."""

    node: int
    level: str
    score: float
    name: str
    best_views: list[int]


class Answer(TypedDict):
    """Answers to a text, or nodes that look like a node or a picture.

    `relevancy` has one number per node, `total` is the number of all answers, `hits` lists the best, and
    `route` is as in `hilsplat.Hit`.
    """

    text: str
    level: str
    hits: list[FoundNode]
    total: int
    relevancy: list[float]
    doubts: list[str]
    caution: str
    route: str
    ms: float


def answer(scene: LanguageScene, asked: Question, answerer: str = "tree") -> Answer:
    """Query a scene, and return hits, each node's relevancy to the last text, and doubts.

    Raises:
        SettingsError: the text is empty, or the view does not exist.
    """
    begin = time.perf_counter()
    view = None if asked.view is None else view_name(scene.scene, asked.view)
    found = scene.select(
        asked.text, level=asked.level, answerer=answerer, view=view, threshold=asked.threshold
    )
    hits, path = scene.hits_of(found, LISTED), path_of(asked.text)
    relevancy = scene.node_relevancy([path[-1]], answerer)[0]
    made = _answer(scene, asked.text, hits, relevancy)
    return {
        **made,
        "level": found.level.label,
        "total": len(found.ids),
        "doubts": [str(doubt) for doubt in doubts_of(found)],
        "caution": scene.caution_about(asked.text),
        "route": found.route,
        "ms": round(1e3 * (time.perf_counter() - begin), 2),
    }


def alike(scene: LanguageScene, hits: Sequence[Hit], what: str, also: Sequence[int] = ()) -> Answer:
    """Return nodes that look like a node or a picture as an answer; nodes in `also` get relevancy 1."""
    relevancy = np.zeros(len(scene.tree))
    relevancy[[hit.node for hit in hits]] = [max(hit.score, 0.0) for hit in hits]
    relevancy[list(also)] = 1
    return _answer(scene, what, hits, relevancy)


def _answer(scene: LanguageScene, text: str, hits: Sequence[Hit], relevancy: np.ndarray) -> Answer:
    found: list[FoundNode] = [
        {
            "node": hit.node,
            "level": hit.level.label,
            "score": round(hit.score, 4),
            "name": hit.name,
            "best_views": [scene.views.index(view) for view in hit.best_views],
        }
        for hit in hits
    ]
    return {
        "text": text,
        "level": hits[0].level.label if hits else "",
        "hits": found,
        "total": len(hits),
        "relevancy": np.round(relevancy, 4).tolist(),
        "doubts": [],
        "caution": "",
        "route": "like",
        "ms": 0,
    }


def boxes(scene: LanguageScene, groups: Sequence[Group]) -> dict[str, Any]:
    """Return the boxes of nodes for other programs; a node of several groups has one in each."""
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
                "level": int(tree.level[node]),
                "parent": int(tree.parent[node]),
                "centre": tree.oriented_box[node][0].tolist(),
                "axes": tree.oriented_box[node][1:4].tolist(),
                "size": tree.oriented_box[node][4].tolist(),
                "corners": box_corners(tree.oriented_box[node]),
                "lower": tree.box[node][0].tolist(),
                "upper": tree.box[node][1].tolist(),
                "centroid": tree.centroid[node].tolist(),
            }
            for group in groups
            for node in group.nodes
        ],
    }
