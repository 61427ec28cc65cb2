"""A semantic tree for tests that use only some of its parts."""

import numpy as np

from hilsplat.semantic_tree.tree import SemanticTree


def plain_tree(level, parent, node_of_gaussian, **more) -> SemanticTree:
    """A tree of one view; other parts are ones, zeros or empty unless given."""
    num, nodes = len(level), np.array(node_of_gaussian, np.int32)
    parts = {
        "clip": np.ones((num, 2), np.float32),
        "centroid": np.zeros((num, 3), np.float32),
        "box": np.zeros((num, 2, 3), np.float32),
        "oriented_box": np.zeros((num, 5, 3), np.float32),
        "quality": np.ones(num, np.float32),
        "views": np.ones(num, np.int32),
        "membership": (nodes >= 0).astype(np.float32),
        "node_of_mask": np.zeros(0, np.int32),
        "linked_node": np.zeros(0, np.int32),
        "crop_score": np.zeros(0, np.float32),
        "crop_rank": np.zeros(0, np.int32),
        "view_area_px": np.ones((num, 1), np.float32),
        "view_names": ("000.png",),
        "gaussians_sha256": "0",
        "cameras_sha256": "0",
        "min_weight": 1 / 255,
    }
    return SemanticTree(
        level=np.array(level, np.uint8),
        parent=np.array(parent, np.int32),
        node_of_gaussian=nodes,
        **{**parts, **more},
    )
