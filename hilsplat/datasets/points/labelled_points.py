"""Points labelled by a benchmark (mesh vertices or lidar returns), and readers for their file formats.

Each reader raises SceneError if its file is missing or damaged.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from hilsplat.base.errors import SceneError, foreign
from hilsplat.datasets.dataset import SceneReport, listing
from hilsplat.scene import layouts
from hilsplat.scene.importers.ply_file import read_ply
from hilsplat.scene.posed_images import PosedImage, rigid_pose

UNPACK_AGAIN = "unpack or download the file again; this copy is damaged or incomplete"
AS_DISTRIBUTED = "use the labelled file distributed with the data set, not an export by another program"

decoding = partial(foreign, fix=UNPACK_AGAIN)


@dataclass(frozen=True, eq=False)
class LabelledPoints:
    """P points with their ground-truth classes, in the frame of the scene's cameras."""

    xyz: Float[np.ndarray, "P 3"]  # metres
    class_id: Int32[np.ndarray, " P"]  # number in the data set's files; 0 if undefined
    instance_id: Int32[np.ndarray, " P"]  # from 1, unrelated to numbers in other files; 0 for none

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class PointScene:
    name: str
    images: tuple[PosedImage, ...]  # frames without a pose are omitted
    truth: Mapping[str, LabelledPoints]  # by key of `classes.LABELLINGS`; only `evaluate` may read them
    warnings: tuple[str, ...] = ()  # a sentence for each item that was skipped or reinterpreted

    def report(self) -> SceneReport:
        facts: dict[str, object] = {"posed images": len(self.images)}
        for labelling, points in self.truth.items():
            facts[f"{labelling} points"] = len(points)
            facts[f"{labelling} points with a class"] = int((points.class_id > 0).sum())
            facts[f"{labelling} classes"] = len(np.unique(points.class_id[points.class_id > 0]))
            facts[f"{labelling} instances"] = len(np.unique(points.instance_id[points.instance_id > 0]))
        return SceneReport(facts, self.warnings)


def require_file(path: Path, fix: str = UNPACK_AGAIN) -> Path:
    """Return the path of a file that must exist; the error lists what its folder contains."""
    if not path.is_file():
        raise SceneError(f"{path} is missing", found=listing(path.parent), fix=fix)
    return path


def read_json_object(path: Path, keys: tuple[str, ...]) -> dict[str, Any]:
    """Read a JSON object that must have the given keys."""
    content = layouts.read_json_object(require_file(path), UNPACK_AGAIN)
    if not content.keys() >= set(keys):
        raise SceneError(
            f"{path} does not have the expected content",
            expected=f"an object with the keys {', '.join(keys)}",
            found=", ".join(sorted(content)[:12]) or "an empty object",
            fix=UNPACK_AGAIN,
        )
    return content


def read_matrices(path: Path, columns: int) -> Float64[np.ndarray, "M 4 4"]:
    """Read a text file: lines of 16 numbers, or one matrix as 4 lines of 4 (inf and nan are allowed)."""
    expected = f"{columns} numbers per line" + (", 4 lines" if columns == 4 else "")
    with decoding(require_file(path), expected=expected):
        rows = np.loadtxt(path, comments=None, encoding="utf-8", ndmin=2)
        if rows.shape[1] != columns or (columns == 4 and len(rows) != 4):
            raise ValueError(f"{rows.shape[0]} lines of {rows.shape[1]} numbers")
    return rows.reshape(-1, 4, 4)


def posed_frame(
    path: Path,
    world_from_cam: Float64[np.ndarray, "4 4"],
    where: str,
    K: Float[np.ndarray, "3 3"],
    size_hw: tuple[int, int],
) -> PosedImage:
    """Return an image of a sequence with its pose, which is described by `where` in messages."""
    return PosedImage(path.name, path, np.linalg.inv(rigid_pose(world_from_cam, where)), K, size_hw)


class PlyMesh:
    """A PLY mesh in which every face has `corners` corners."""

    def __init__(self, path: Path, corners: int, fix: str = UNPACK_AGAIN) -> None:
        self.path, self.fix, self.corners = require_file(path, fix), fix, corners
        with foreign(path, expected=f"a PLY mesh with {corners} corners per face", fix=fix):
            try:
                self._content = read_ply(path, corners)
            except Exception:  # is raised again, unless the file is intact but has other faces
                self._content = read_ply(path)
            for element in ("vertex", "face"):
                self._content[element]  # raises KeyError if the element is missing

    def column(self, element: str, name: str) -> np.ndarray:
        data = self._content[element].data
        if name not in data.dtype.names:
            raise SceneError(
                f"the {element} element of {self.path} has no property {name}",
                expected=name,
                found=", ".join(data.dtype.names),
                fix=AS_DISTRIBUTED,
            )
        return np.asarray(data[name])

    @cached_property
    def xyz(self) -> Float32[np.ndarray, "P 3"]:
        return np.stack([self.column("vertex", axis) for axis in "xyz"], axis=1).astype(np.float32)

    @cached_property
    def faces(self) -> Int32[np.ndarray, "F corners"]:
        """Vertex indices of all faces' corners, checked against the number of vertices."""
        rows = self.column("face", "vertex_indices")
        listed = rows[:1] if rows.ndim == 2 else rows  # rows of an array have the same length
        if other := {len(face) for face in listed} - {self.corners}:
            raise SceneError(
                f"{self.path} has faces with {', '.join(map(str, sorted(other)))} corners",
                expected=f"{self.corners} corners per face",
                fix=AS_DISTRIBUTED,
            )
        faces = np.array([*rows] if rows.dtype == object else rows, np.int32).reshape(-1, self.corners)
        count = len(self._content["vertex"].data)
        if faces.size and (faces.min() < 0 or faces.max() >= count):
            raise SceneError(f"{self.path}: a face has an invalid vertex index", fix=self.fix)
        return faces
