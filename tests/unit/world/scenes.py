"""Scenes built by hand from a mesh, and scenes of the world that several tests read."""

from functools import cache

import numpy as np

from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat_world.paints import Paint
from hilsplat_world.scenes.kinds import build_scene
from hilsplat_world.scenes.scene import Style, WorldScene
from hilsplat_world.shapes import Mesh

GREY = Paint("grey", "mottled", (0.5, 0.5, 0.5), (0.5, 0.5, 0.5), 9.0, 0.0, 10.0, 0.0, (5.0, 6.0, 7.0))


@cache
def built(kind: str, seed: int = 100, objects: int = 7) -> WorldScene:
    return build_scene(kind, seed, objects)


def scene_of(mesh: Mesh, paint: Paint = GREY, node_ids=None, style: Style | None = None) -> WorldScene:
    """A scene of one mesh in one paint; its triangles belong to one whole unless `node_ids` are given."""
    count = len(mesh)
    ids = np.array([[0, -1, -1]] * count if node_ids is None else node_ids, np.int32)
    nodes = tuple(AnnotatedNode(row, 1, -1, f"thing {row}") for row in range(ids.max() + 1))
    corners = mesh.triangles.astype(np.float32)
    return WorldScene(
        "test", 0, 1, (), corners, mesh.normals.astype(np.float32), corners, ids,
        np.zeros(count, np.int32), paint.row()[None], nodes, frozenset(), style or Style(),
    )  # fmt: skip
