"""Labels of Replica's meshes: object ids of quads in the release, or class ids of vertices as text."""

from collections import Counter
from pathlib import Path

import numpy as np
from jaxtyping import Int, Int32

from hilsplat.base.errors import SceneError
from hilsplat.datasets.classes.replica import NAMES
from hilsplat.datasets.points.labelled_points import LabelledPoints
from hilsplat.datasets.points.point_files import (
    UNPACK_AGAIN,
    ply_column,
    ply_faces,
    ply_places,
    read_json_object,
    read_numbers,
    read_ply,
    require_file,
)

INSTANCES_PER_CLASS = 1000
"""Values in instance files are class * 1000 + instance; values below 1000 are not objects."""


def class_of_objects(path: Path) -> Int32[np.ndarray, " O"]:
    """Return the class of each object id, from `info_semantic.json`; negative ids (undefined, none) become 0.

    Raises:
        SceneError: the file is damaged, names a class not as in the release, or has an unknown id.
    """
    content = read_json_object(path, ("classes", "id_to_label"))
    try:
        classes = np.asarray(content["id_to_label"], dtype=np.int32).reshape(-1)
        names = {int(entry["id"]): str(entry["name"]) for entry in content["classes"]}
    except (TypeError, ValueError, KeyError) as error:
        raise SceneError(
            f"{path} cannot be read: {error!r}",
            expected="id_to_label: a list of class ids; classes: objects with id and name",
            fix=UNPACK_AGAIN,
        ) from error
    other = [f"{number} {name}" for number, name in names.items() if NAMES.get(number) != name]
    strange = sorted(set(classes[classes > 0].tolist()) - set(NAMES))
    if other or strange:
        raise SceneError(
            f"{path} has classes that Replica does not",
            expected=f"the {len(NAMES)} of the release, such as {NAMES[1]} (1)",
            found=", ".join([*other[:5], *(f"class id {number}" for number in strange[:5])]),
            fix="take the file of the original release",
        )
    return np.maximum(classes, 0)


def object_of_vertices(
    faces: Int[np.ndarray, "F c"], object_of_face: Int[np.ndarray, " F"], num_vertices: int
) -> Int32[np.ndarray, " P"]:
    """Return the most frequent object of each vertex's faces, -1 without faces; the lowest id wins ties."""
    corners, owners = faces.reshape(-1).astype(np.int64), np.repeat(object_of_face, faces.shape[1])
    pairs, votes = np.unique(np.stack([corners, owners]), axis=1, return_counts=True)
    # The last entry of each vertex has the most votes and, among ties, the smallest id.
    order = np.lexsort((-pairs[1], votes, pairs[0]))
    vertex, owner = pairs[0][order], pairs[1][order]
    last = np.flatnonzero(np.append(vertex[1:] != vertex[:-1], True)) if len(vertex) else order
    result = np.full(num_vertices, -1, dtype=np.int32)
    result[vertex[last]] = owner[last]
    return result


def triangles_of(quads: Int32[np.ndarray, "F 4"]) -> Int32[np.ndarray, "T 3"]:
    """Split each quad into triangles, corners 0 1 2 and 0 2 3; degenerate ones are dropped."""
    triangles = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return triangles[(triangles != triangles[:, [1, 2, 0]]).all(axis=1)]


def read_semantic_mesh(habitat: Path) -> LabelledPoints:
    """Return the vertices of `mesh_semantic.ply` with the class and instance of most of their faces.

    The file numbers objects from 0; `instance_id` is that number + 1, and 0 if the class is undefined.

    Raises:
        SceneError: a file is missing or damaged, or the files do not belong together.
    """
    path = habitat / "mesh_semantic.ply"
    mesh = read_ply(path, 4)
    classes = class_of_objects(habitat / "info_semantic.json")
    quads = ply_faces(path, mesh)
    of_face = ply_column(path, mesh, "face", "object_id").astype(np.int64)
    if of_face.size and (of_face.min() < 0 or of_face.max() >= len(classes)):
        raise SceneError(
            f"{path} and info_semantic.json do not belong together",
            expected=f"object ids 0 to {len(classes) - 1}",
            found=f"{of_face.min()} to {of_face.max()}",
            fix="take both files from the same scene",
        )
    xyz = ply_places(path, mesh)
    owner = object_of_vertices(quads, of_face, len(xyz))
    class_id = np.where(owner >= 0, classes[owner], 0).astype(np.int32)
    instance = np.where(class_id > 0, owner + 1, 0).astype(np.int32)
    return LabelledPoints(xyz, class_id, instance, "replica", triangles_of(quads))


def read_vertex_labels(path: Path, num_vertices: int) -> Int32[np.ndarray, " P"]:
    """Read `semantic_labels_<scene>.txt`: a class id per line, where negative ones become 0.

    Raises:
        SceneError: the file does not contain exactly one known integer per vertex.
    """
    require_file(path)
    try:
        labels = np.array(path.read_text(encoding="utf-8").split(), dtype=np.int32)
    except ValueError as error:
        raise SceneError(f"{path} does not hold whole numbers: {error}", fix=UNPACK_AGAIN) from error
    if len(labels) != num_vertices:
        raise SceneError(
            f"{path} does not label the vertices of its mesh",
            expected=f"{num_vertices} lines",
            found=f"{len(labels)}",
            fix="take the mesh and the labels of the same scene and release",
        )
    unknown = Counter(labels[~np.isin(labels, [*NAMES, 0, -1, -2])].tolist())
    if unknown:
        raise SceneError(
            f"{path} has classes that Replica does not",
            expected=f"1 to {max(NAMES)}, 0, -1 or -2",
            found=", ".join(f"{number} ({count} lines)" for number, count in sorted(unknown.items())[:5]),
            fix="use semantic_labels_<scene>.txt, not instance_labels_<scene>.txt",
        )
    return np.maximum(labels, 0)


def read_labelled_mesh(mesh_path: Path, labels: Path, instances: Path | None = None) -> LabelledPoints:
    """Read a mesh of the NICE-SLAM package with OpenNeRF's text files of vertex labels.

    Args:
        mesh_path: `<scene>_mesh.ply`, quads or triangles.
        labels: `semantic_labels_<scene>.txt`.
        instances: `instance_labels_<scene>.txt` (class * 1000 + instance), if available.

    Raises:
        SceneError: a file is missing or damaged, or the files do not belong together.
    """
    try:
        mesh = read_ply(mesh_path, 3)
        faces = ply_faces(mesh_path, mesh)
    except SceneError:
        mesh = read_ply(mesh_path, 4)
        faces = triangles_of(ply_faces(mesh_path, mesh))
    xyz = ply_places(mesh_path, mesh)
    class_id = read_vertex_labels(labels, len(xyz))
    instance = np.zeros(len(xyz), dtype=np.int32)
    if instances is not None:
        values = read_numbers(instances, 1)[:, 0].astype(np.int32)
        if len(values) != len(xyz):
            raise SceneError(
                f"{instances} does not label the vertices of {mesh_path}",
                expected=f"{len(xyz)} lines",
                found=len(values),
                fix="take the files of the same scene",
            )
        instance = np.where(values >= INSTANCES_PER_CLASS, values, 0).astype(np.int32)
    return LabelledPoints(xyz, class_id, instance, "replica", faces)
