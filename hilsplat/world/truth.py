"""What is true of a synthetic scene: annotated regions per view, and its mesh with node ids."""

from collections import defaultdict
from collections.abc import Collection
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from hilsplat.base.artifacts import atomic_path
from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat.world.scenes.scene import WorldScene

SUBPART_AREA_AT_PX = 384
"""Size of the view for which the smallest area of a subpart is stated."""


def smallest_areas(image_px: int, min_area_px: int, min_subpart_area_px: int) -> dict[Level, float | int]:
    """Area from which a text is annotated in a view, per level, px.

    Args:
        image_px: height and width of the view.
        min_area_px: for wholes and parts, whatever the size of the view.
        min_subpart_area_px: for subparts in a view of 384 px; scales with the area of the view.
    """
    scaled = min_subpart_area_px * (image_px / SUBPART_AREA_AT_PX) ** 2
    return {Level.WHOLE: min_area_px, Level.PART: min_area_px, Level.SUBPART: scaled}


def annotated_nodes(
    labels: Int32[np.ndarray, "3 H W"],
    nodes: tuple[AnnotatedNode, ...],
    background: Collection[int],
    smallest: dict[Level, float | int],
) -> tuple[int, ...]:
    """Nodes that are scored in a view.

    Nodes that share a text (four legs) answer one query, so their regions are judged together: where
    the union is large enough all that are visible are annotated, else none. A single large leg with
    three small ones left out would make the true region wrong.

    Args:
        labels: node id per level and pixel, -1 for none.
        nodes: all nodes of the scene.
        background: ids that are never scored (table, floor, walls).
        smallest: area per level from which a text is scored, px.

    Returns:
        Ids in ascending order.
    """
    kept: list[int] = []
    for level in LEVELS:
        area_px: dict[str, int] = defaultdict(int)
        visible: dict[str, list[int]] = defaultdict(list)
        for node_id, count in zip(*np.unique(labels[level.index], return_counts=True), strict=True):
            if node_id >= 0 and int(node_id) not in background:
                text = nodes[node_id].text
                area_px[text] += int(count)
                visible[text].append(int(node_id))
        for text, ids in visible.items():
            if area_px[text] >= smallest[level]:
                kept.extend(ids)
    return tuple(sorted(kept))


def write_mesh(path: Path, scene: WorldScene) -> None:
    """Write the scene as binary PLY: vertices x, y, z; faces with `whole`, `part`, `subpart` node ids.

    Coordinates are those of the true cameras; corners at the same place are one vertex.
    """
    corners, index = np.unique(scene.triangles.reshape(-1, 3), axis=0, return_inverse=True)
    faces = np.empty(
        len(scene.triangles),
        dtype=[("count", "u1"), ("corners", "<i4", 3), ("whole", "<i4"), ("part", "<i4"), ("subpart", "<i4")],
    )
    faces["count"] = 3
    faces["corners"] = index.reshape(-1, 3)
    for level in LEVELS:
        faces[level.label] = scene.node_ids[:, level.index]
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {len(corners)}",
            *(f"property float {axis}" for axis in "xyz"),
            f"element face {len(faces)}",
            "property list uchar int vertex_indices",
            *(f"property int {level.label}" for level in LEVELS),
            "end_header\n",
        ]
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(header.encode() + corners.astype("<f4").tobytes() + faces.tobytes())
