"""Hierarchical annotations: level, parent and text of each node, and its region in each view.

This is our own format for benchmarks like Hi-LERF, whose format is unpublished. A folder contains

    annotations.json          nodes (the tree) and the ids of the nodes annotated in each view
    labels/<view>.<level>.png 16-bit label images: node id + 1, 0 where there is no node

Only `evaluate` and the diagnostic segmenter (`truth_masks`) may read the folder.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int32

from hilsplat.base.artifacts import read_json, write_json
from hilsplat.base.errors import ArtifactError
from hilsplat.base.images import opened_image, write_png
from hilsplat.base.levels import LEVELS, NONE, Level

FORMAT = "hilsplat-hierarchy-1"


@dataclass(frozen=True)
class AnnotatedNode:
    """One annotated object, part or subpart of a scene."""

    id: int  # row in the list of nodes
    level: int  # 1 whole, 2 part, 3 subpart
    parent: int  # id of the node one level up, -1 for a whole
    text: str  # query for the node; the masks of nodes with the same text are merged
    synonyms: tuple[str, ...] = ()


@dataclass(frozen=True)
class HierarchyAnnotations:
    folder: Path  # contains the label images
    nodes: tuple[AnnotatedNode, ...]  # by id
    views: Mapping[str, tuple[int, ...]]  # ids of the annotated nodes that are large enough to be scored

    def label_image(self, view: str, level: Level) -> Int32[np.ndarray, "H W"]:
        """Return the node id per pixel, -1 for none."""
        with opened_image(label_path(self.folder, view, level), "label image") as image:
            return np.asarray(image).astype(np.int32) - 1

    def texts(self, view: str, level: Level) -> dict[str, tuple[int, ...]]:
        """Return the texts annotated in a view at a level, with the ids of their nodes."""
        texts: dict[str, list[int]] = {}
        for node_id in self.views.get(view, ()):
            node = self.nodes[node_id]
            if node.level == int(level):
                texts.setdefault(node.text, []).append(node_id)
        return {text: tuple(ids) for text, ids in texts.items()}

    def mask(self, view: str, ids: Iterable[int]) -> Bool[np.ndarray, "H W"]:
        """Return the union of the nodes' regions in a view; all nodes must have the same level."""
        ids = tuple(ids)
        return np.isin(self.label_image(view, Level(self.nodes[ids[0]].level)), ids)

    def path_of(self, node_id: int) -> tuple[str, ...]:
        """Return the texts from the whole down to the node, such as ("bear", "head", "nose")."""
        texts: list[str] = []
        while node_id != NONE:
            texts.insert(0, self.nodes[node_id].text)
            node_id = self.nodes[node_id].parent
        return tuple(texts)

    @staticmethod
    def load(folder: Path) -> "HierarchyAnnotations":
        """Read a folder's annotations; raise ArtifactError if they are missing or have a different format."""
        record = read_json(folder / "annotations.json")
        if record.get("format") != FORMAT:
            raise ArtifactError(
                f"{folder}/annotations.json has an unsupported format",
                expected=FORMAT,
                found=record.get("format"),
            )
        nodes = (AnnotatedNode(**{**node, "synonyms": tuple(node["synonyms"])}) for node in record["nodes"])
        views = {view: tuple(ids) for view, ids in record["views"].items()}
        return HierarchyAnnotations(folder, tuple(nodes), views)


def label_path(folder: Path, view: str, level: Level) -> Path:
    return folder / "labels" / f"{view}.{level.label}.png"


def write_hierarchy(
    folder: Path,
    nodes: Iterable[AnnotatedNode],
    labels: Mapping[str, Mapping[Level, Int32[np.ndarray, "H W"]]],
    views: Mapping[str, Iterable[int]],
) -> None:
    """Write annotations: label images first, `annotations.json` last.

    The nodes must be sorted by id (0, 1, 2, ...). `labels` contains the node id of each pixel (-1 for
    none) by view and level, and `views` contains the ids of the nodes annotated in each view.
    """
    for view, levels in labels.items():
        for level in LEVELS:
            write_png(label_path(folder, view, level), (levels[level] + 1).astype(np.uint16))
    record = {
        "format": FORMAT,
        "nodes": [asdict(node) for node in nodes],
        "views": {view: list(ids) for view, ids in views.items()},
    }
    write_json(folder / "annotations.json", record)
