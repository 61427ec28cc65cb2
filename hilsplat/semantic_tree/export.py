"""Export of the semantic tree as JSON, and as a PLY with the nodes of each Gaussian."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32, Int64

from hilsplat.base.atomic import atomic_path
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.lineage import require_made_from, sha256_of_file
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.splat.coordinates import source_comments
from hilsplat.splat.gaussians import base_rgb


def readable_nodes(tree: SemanticTree) -> list[dict[str, Any]]:
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

    Gaussian viewers ignore them; tools that display scalar fields can show them as colours. -1 means no node.

    Raises:
        MisalignedArtifactError: the tree was computed from a different PLY.
    """
    digest = sha256_of_file(gaussians_ply)
    require_made_from("the semantic tree", gaussians_ply, tree.gaussians_sha256, digest)
    nodes = {f"node_{level.label}": tree.node_of_gaussian[:, level.index] for level in LEVELS}
    _write(gaussians_ply, slice(None), nodes, out)


def write_selection_ply(
    gaussians_ply: Path,
    rows: Int64[np.ndarray, " g"],
    out: Path,
    labels: Int32[np.ndarray, " g"] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Copy selected Gaussians from a 3DGS PLY, such as the answer to a query.

    Args:
        labels: label of each Gaussian, counted from 1; written as the property `label`.
        comments: lines of the header, such as `label 1: mug`.
    """
    # PLY headers are ASCII, and a comment is one line.
    plain = [" ".join(comment.split()).encode("ascii", "backslashreplace").decode() for comment in comments]
    _write(gaussians_ply, rows, {} if labels is None else {"label": labels}, out, plain)


def _write(
    ply: Path,
    rows: Int64[np.ndarray, " g"] | slice,
    columns: dict[str, np.ndarray],
    out: Path,
    comments: Sequence[str] = (),
) -> None:
    """Copy rows of a PLY, with a comment that states the coordinates and, if any, additional columns.

    With these, it also has colours, which Gaussian viewers ignore, for programs that read points.
    """
    from plyfile import PlyData, PlyElement

    vertex = PlyData.read(str(ply))["vertex"].data[rows]
    if columns:
        rgb = base_rgb(np.stack([vertex[f"f_dc_{band}"] for band in range(3)], axis=1)[:, None])
        columns = columns | dict(
            zip(("red", "green", "blue"), np.rint(255 * rgb.T).astype(np.uint8), strict=True)
        )
    types = [(name, column.dtype.str) for name, column in columns.items()]
    table = np.empty(len(vertex), [*vertex.dtype.descr, *types])
    for name in (*vertex.dtype.names, *columns):
        table[name] = columns[name] if name in columns else vertex[name]
    with atomic_path(out) as temporary:
        element = PlyElement.describe(table, "vertex")
        PlyData([element], byte_order="<", comments=[*source_comments(ply), *comments]).write(str(temporary))
