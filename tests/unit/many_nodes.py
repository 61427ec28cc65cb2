"""A finished scene with more nodes than 16 bits can number."""

from pathlib import Path

import numpy as np

from hilsplat.base.artifacts import read_index, read_npy, read_npz, write_npy, write_npz
from tests.unit.artifact_changes import change_index


def add_nodes(scene: Path, count: int) -> None:
    """Insert `count` nodes without Gaussians before the nodes of `finished_desk`, with masks in one view.

    One in a hundred is a whole, and the next ones are its parts. They look generic, so no query finds them.
    """
    tree, clip = scene / "default/semantic_tree", scene / "default/clip"
    first = next(iter(read_index(tree)["views"]))
    arrays, vectors = read_npz(tree / "tree.npz"), read_npy(clip / f"{first}.npy")
    grey = np.full((count, vectors.shape[1]), (vectors.shape[1] ** -0.5), vectors.dtype)
    write_npy(clip / f"{first}.npy", np.concatenate([vectors, grey]))
    for name in ("parent", "node_of_gaussian", "node_of_mask", "linked_node"):
        arrays[name] = np.where(arrays[name] >= 0, arrays[name] + count, -1).astype(np.int32)
    nodes = ("level", "parent", "clip", "centroid", "box", "oriented_box", "quality", "views", "view_area_px")
    for name in nodes:
        new = np.zeros((count, *arrays[name].shape[1:]), arrays[name].dtype)
        arrays[name] = np.concatenate([new, arrays[name]])
    rows, masks = np.arange(count), len(vectors)
    is_whole = rows % 100 == 0
    arrays["level"][:count] = np.where(is_whole, 1, 2)
    arrays["parent"][:count] = np.where(is_whole, -1, rows - rows % 100)
    for name, new in (
        ("node_of_mask", rows),
        ("linked_node", rows),
        ("crop_score", rows + 1),
        ("crop_rank", rows),
    ):
        old = arrays[name]
        arrays[name] = np.concatenate([old[:masks], new.astype(old.dtype), old[masks:]])
    write_npz(tree / "tree.npz", **arrays)
    change_index(tree)
    change_index(clip)
