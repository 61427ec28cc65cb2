"""Ground truth of a synthetic scene: annotated regions per view, a mesh with node ids, and exact depth."""

from collections import defaultdict
from collections.abc import Collection
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, Int64

from hilsplat.base.atomic import atomic_path
from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat.datasets.points.labelled_points import PlyMesh
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat_world.rays import RayCaster
from hilsplat_world.scenes.scene import WorldScene

MIN_SUBPART_AREA = 100 / 384**2
"""Minimum visible area of a scored subpart, as a fraction of the view: 100 of 384 x 384 px."""

HIDDEN_BY = 2e-3
"""A point is hidden if a surface is nearer to the camera by at least this fraction of the distance."""


def annotated_nodes(
    labels: Int32[np.ndarray, "3 H W"],
    nodes: tuple[AnnotatedNode, ...],
    background: Collection[int],
    smallest: dict[Level, float | int],
) -> tuple[int, ...]:
    """Return the ids of the nodes that are scored in a view, in ascending order.

    Nodes with the same text (four legs) match one query, so the size limit applies to their union: either
    all visible nodes are annotated or none. The ground truth would be wrong if one large leg were annotated
    and three small legs were not.

    Args:
        labels: node id per level and pixel, -1 for none.
        background: ids that are never scored (table, floor, walls).
        smallest: minimum area of a scored query by level, px.
    """
    annotated: list[int] = []
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
                annotated.extend(ids)
    return tuple(sorted(annotated))


def write_mesh(path: Path, scene: WorldScene, cameras: Cameras, longest_edge: float | None = None) -> None:
    """Write the scene as a binary PLY with the node ids of faces and vertices.

    Vertices have x, y, z, the ids `whole`, `part` and `subpart` (-1: none) and `views`, the number of cameras
    in which they are visible (at most 255). Faces have the same three ids. Corners at one position share a
    vertex only if their faces have the same ids, so both sides of a border have separate vertices. Protocols
    that score vertices, such as ScanNet's, need evenly spaced visible vertices; a plain wall has only four.

    Edges longer than `longest_edge` (scene units) are halved until none remain; None keeps the triangles.
    """
    triangles, owner = scene.triangles, np.arange(len(scene.triangles))
    if longest_edge is not None:
        triangles, owner = refined(triangles, longest_edge)
    ids = scene.node_ids[owner]
    # float32 represents ids exactly up to 2**24, so ids and positions fit in one array.
    rows = np.concatenate([np.repeat(ids, 3, axis=0).astype(np.float32), triangles.reshape(-1, 3)], axis=1)
    unique, index = unique_rows(rows)
    id_fields = [(level.label, "<i4") for level in LEVELS]
    vertices = np.empty(len(unique), [*((axis, "<f4") for axis in "xyz"), *id_fields, ("views", "u1")])
    for column, name in enumerate([*(level.label for level in LEVELS), *"xyz"]):
        vertices[name] = unique[:, column]
    vertices["views"] = np.minimum(views_of_points(scene, cameras, np.ascontiguousarray(unique[:, 3:])), 255)
    faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3), *id_fields])
    faces["count"] = 3
    faces["corners"] = index.reshape(-1, 3)
    for level in LEVELS:
        faces[level.label] = ids[:, level.index]
    # plyfile writes a list property row by row, which takes ten times as long.
    id_lines = [f"property int {level.label}" for level in LEVELS]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [*(f"property float {axis}" for axis in "xyz"), *id_lines, "property uchar views"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += [*id_lines, "end_header\n"]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def unique_rows(
    rows: Float32[np.ndarray, "N C"],
) -> tuple[Float32[np.ndarray, "U C"], Int64[np.ndarray, " N"]]:
    """Return `np.unique(rows, axis=0, return_inverse=True)` in a quarter of the time, from `np.lexsort`."""
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    is_new = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    index = np.empty(len(rows), np.int64)
    index[order] = np.cumsum(is_new) - 1
    return ordered[is_new], index


def views_of_points(
    scene: WorldScene, cameras: Cameras, points: Float32[np.ndarray, "N 3"]
) -> Int32[np.ndarray, " N"]:
    """Count the cameras in which each surface point of the scene is inside the image and not hidden."""
    seen = np.zeros(len(points), np.int32)
    for name in cameras.names:
        camera = cameras[name]
        local = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (camera.K[a, a] * local[:, a] / local[:, 2] + camera.K[a, 2] for a in range(2))
        height, width = camera.size_hw
        rows = np.flatnonzero((local[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
        centre = camera.centre.astype(np.float32)
        ways = points[rows] - centre
        distance = np.linalg.norm(ways, axis=1).astype(np.float32)
        reach = distance * np.float32(1 - HIDDEN_BY)
        seen[rows] += ~scene.caster.blocked(centre[None], ways / distance[:, None], reach)
    return seen


def refined(
    triangles: Float32[np.ndarray, "F 3 3"], longest_edge: float
) -> tuple[Float32[np.ndarray, "G 3 3"], Int64[np.ndarray, " G"]]:
    """Halve all edges longer than `longest_edge` until none remain.

    Whether an edge is halved depends only on its two ends, so no cracks open between adjacent triangles.

    Returns:
        The smaller triangles and, for each, the row in `triangles` that contains it.
    """
    owner = np.arange(len(triangles))
    done, done_owner = [], []
    while len(triangles):
        ends = triangles[:, [1, 2, 0]]
        long = np.linalg.norm(ends - triangles, axis=2) > longest_edge  # edge k: from corner k to the next
        count = long.sum(axis=1)
        done.append(triangles[count == 0])
        done_owner.append(owner[count == 0])
        pieces, owners = [], []
        for number in (1, 2, 3):
            rows = np.flatnonzero(count == number)
            # Rotate the corners so that the long edges come first: edge 0, edges 0 and 1, or all edges.
            first = long[rows].argmax(axis=1) if number == 1 else (long[rows].argmin(axis=1) + 1) % 3
            order = (first[:, None] + np.arange(3)) % 3
            a, b, c = (triangles[rows, order[:, k]] for k in range(3))
            ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
            split = {
                1: [(a, ab, c), (ab, b, c)],
                2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
                3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
            }[number]
            pieces += [np.stack(corners, axis=1) for corners in split]
            owners += [owner[rows]] * len(split)
        triangles, owner = np.concatenate(pieces), np.concatenate(owners)
    return np.concatenate(done), np.concatenate(done_owner)


def load_surface(path: Path) -> RayCaster:
    """Return a ray caster for a `mesh.ply`; raise `SceneError` if the file is missing or not a mesh."""
    mesh = PlyMesh(path, 3, fix="delete the truth folder and rerun the world stage")
    return RayCaster(mesh.xyz[mesh.faces])


def true_depth(surface: RayCaster, camera: Camera) -> Float32[np.ndarray, "H W"]:
    """Return the depth along the optical axis at pixel centres, scene units; inf if nothing is hit."""
    height, width = camera.size_hw
    y, x = np.mgrid[:height, :width] + 0.5
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rotation = camera.cam_from_world[:3, :3]
    # directions have depth 1, so the distance is the depth
    directions = (pixels @ np.linalg.inv(camera.K).T @ rotation).astype(np.float32)
    hits = surface.nearest(camera.centre.astype(np.float32)[None], directions)
    return hits.distance.reshape(height, width)
