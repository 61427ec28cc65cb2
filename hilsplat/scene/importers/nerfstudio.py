"""nerfstudio's training coordinates, for which its data parser rotates, centres and scales the poses."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.errors import SceneError
from hilsplat.scene.layouts import read_json_object

FIX = "copy it again from nerfstudio"

BEFORE_APPLIED_TRANSFORM = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
"""Transform of COLMAP coordinates by `ns-process-data` versions that do not record `applied_transform`."""


def source_from_dataparser(dataparser: Path, transforms: Path | None) -> Float64[np.ndarray, "4 4"]:
    """Return the similarity from nerfstudio's training coordinates to those of the source's poses.

    `dataparser_transforms.json` maps original coordinates, usually COLMAP's, to training coordinates:
    `x_training = scale * (transform @ [x_original, 1])`. The poses in `transforms.json` are in a third
    coordinate system, which `applied_transform` and `applied_scale` in that file relate to the original one.
    If `transforms` is None, the poses are those of a COLMAP model.
    """
    content = read_json_object(dataparser, FIX)
    applied, applied_scale = np.eye(4), 1.0
    if transforms is not None:
        saved = read_json_object(transforms, FIX)
        if "applied_transform" in saved:
            applied = _matrix(transforms, "applied_transform", saved)
        elif (transforms.parent / "colmap/sparse/0").is_dir():
            applied[:3] = BEFORE_APPLIED_TRANSFORM
        applied_scale = _scale(transforms, "applied_scale", saved)
    training_from_source = _matrix(dataparser, "transform", content) @ np.linalg.inv(applied)
    training_from_source[:3] *= _scale(dataparser, "scale", content) / applied_scale
    return np.linalg.inv(training_from_source)


def _matrix(path: Path, key: str, content: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    try:
        matrix[:3] = np.array(content[key], np.float64)[:3]
        usable = bool(np.isfinite(matrix).all()) and abs(np.linalg.det(matrix)) > 1e-12
    except (KeyError, TypeError, ValueError, IndexError):
        usable = False
    if not usable:
        raise SceneError(
            f"{path}: {key} is not valid",
            expected="an invertible 3 x 4 matrix",
            found=repr(content.get(key))[:80],
            fix=FIX,
        )
    return matrix


def _scale(path: Path, key: str, content: dict[str, Any]) -> float:
    value = content.get(key, 1.0)
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value < float("inf"):
        raise SceneError(f"{path}: {key} is not a positive number", found=repr(value)[:80])
    return float(value)
