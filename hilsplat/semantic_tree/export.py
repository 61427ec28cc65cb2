"""Export of the semantic tree as JSON, and as a PLY with the nodes of each Gaussian."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int32, Int64

from hilsplat.base.artifacts import atomic_path
from hilsplat.base.levels import LEVELS, Level
from hilsplat.scene.finished import require_same
from hilsplat.semantic_tree.tree import SemanticTree


def readable_nodes(tree: SemanticTree) -> list[dict]:
    """Return one human-readable entry per node."""
    members = [np.bincount(column[column >= 0], minlength=len(tree)) for column in tree.node_of_gaussian.T]
    return [
        {
            "node": node,
            "level": Level(int(tree.level[node])).label,
            "parent": int(tree.parent[node]),
            "children": tree.children_of(np.array([node])).tolist(),
            "gaussians": int(members[Level(int(tree.level[node])).index][node]),
            "views": int(tree.views[node]),
            "best_view": tree.view_names[int(tree.view_area_px[node].argmax())],
            "quality": round(float(tree.quality[node]), 4),
            "centroid": [round(float(value), 4) for value in tree.centroid[node]],
            "oriented_box": [[round(float(value), 4) for value in row] for row in tree.oriented_box[node]],
            "box": [[round(float(value), 4) for value in corner] for corner in tree.box[node]],
        }
        for node in range(len(tree))
    ]


def write_tree_ply(gaussians_ply: Path, tree: SemanticTree, out: Path) -> None:
    """Copy a 3DGS PLY and add three properties per Gaussian: `node_whole`, `node_part`, `node_subpart`.

    Gaussian viewers ignore them; tools that show scalar fields can colour by them. -1 means no node.

    Raises:
        MisalignedArtifactError: the tree was made for another PLY.
    """
    from plyfile import PlyData

    require_same("semantic tree", str(gaussians_ply.parent), gaussians_ply, tree.gaussians_sha256)
    vertex = PlyData.read(str(gaussians_ply))["vertex"].data
    more = [(f"node_{level.label}", "<i4") for level in LEVELS]
    table = np.empty(len(vertex), [*vertex.dtype.descr, *more])
    for name in vertex.dtype.names:
        table[name] = vertex[name]
    for level in LEVELS:
        table[f"node_{level.label}"] = tree.node_of_gaussian[:, level.index]
    _write(table, out)


def write_selection_ply(
    gaussians_ply: Path,
    rows: Int64[np.ndarray, " g"],
    out: Path,
    labels: Int32[np.ndarray, " g"] | None = None,
    names: Sequence[str] = (),
) -> None:
    """Copy some Gaussians of a 3DGS PLY, such as those that answer a query.

    Args:
        labels: label of each Gaussian, from 1; written as the property `label`.
        names: name of each label; the header gets a comment for each, such as `label 1: mug`.
    """
    from plyfile import PlyData

    table = PlyData.read(str(gaussians_ply))["vertex"].data[rows]
    if labels is None:
        _write(table, out)
        return
    labelled = np.empty(len(table), [*table.dtype.descr, ("label", "<i4")])
    for name in table.dtype.names:
        labelled[name] = table[name]
    labelled["label"] = labels
    # PLY headers are ASCII, and a comment is one line.
    plain = [" ".join(name.split()).encode("ascii", "backslashreplace").decode() for name in names]
    _write(labelled, out, [f"label {number + 1}: {name}" for number, name in enumerate(plain)])


def _write(table: np.ndarray, out: Path, comments: Sequence[str] = ()) -> None:
    from plyfile import PlyData, PlyElement

    with atomic_path(out) as temporary:
        element = PlyElement.describe(table, "vertex")
        PlyData([element], byte_order="<", comments=list(comments)).write(str(temporary))
