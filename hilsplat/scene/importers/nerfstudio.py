"""nerfstudio's training coordinates, for which its data parser rotates, centres and scales the poses."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.errors import SceneError, foreign
from hilsplat.scene.layouts import read_json_object
from hilsplat.scene.posed_images import rigid_pose

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
        applied_scale = _scale(transforms, "applied_scale", {"applied_scale": 1.0, **saved})
    training_from_source = _matrix(dataparser, "transform", content) @ np.linalg.inv(applied)
    training_from_source[:3] *= _scale(dataparser, "scale", content) / applied_scale
    return np.linalg.inv(training_from_source)


def _matrix(path: Path, key: str, content: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    with foreign(f"{path}: {key}", fix=FIX):
        return rigid_pose(np.array(content[key], np.float64), f"{path}: {key}")


def _scale(path: Path, key: str, content: dict[str, Any]) -> float:
    value = content.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value < float("inf"):
        raise SceneError(f"{path}: {key} is not a positive number", found=repr(value)[:80])
    return float(value)
