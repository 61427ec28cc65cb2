"""JSON file beside `gaussians.ply` that relates its coordinates to those of the scene's source."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.artifacts import read_json, sha256_of_file, write_json
from hilsplat.base.errors import ArtifactError
from hilsplat.scene.scene import Scene
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply, save_ply
from hilsplat.splat.similarity import decompose, move_gaussians

AXES = "right-handed; cameras in OpenCV axes (x right, y down, z forward)"


def coordinates_path(ply: Path) -> Path:
    """Return the path of `gaussians.json` beside `gaussians.ply`."""
    return Path(ply).with_suffix(".json")


def write_coordinates(ply: Path, scene: Scene, gaussians: Gaussians, origin: dict[str, Any]) -> None:
    """Write the transform between a PLY's coordinates, which are the scene's, and those of its source.

    The source of the poses is an imported COLMAP model or transforms.json, or our own structure from motion,
    whose coordinates are not recorded elsewhere.

    Args:
        ply: the written file, whose digest is recorded: the JSON applies to no other file.
        origin: origin of the Gaussians, as in the report.
    """
    scale, rotation, translation = decompose(scene.scene_from_source)
    registration = read_json(scene.folder / "registration.json")
    write_json(
        coordinates_path(ply),
        {
            "scene": scene.name,
            "ply": Path(ply).name,
            "ply_sha256": sha256_of_file(ply),
            "gaussians": len(gaussians),
            "sh_degree": gaussians.sh_degree,
            "unit": scene.unit,
            "axes": AXES,
            "source": registration["poses"],
            "convention": "x_scene = scene_from_source @ [x_source, 1]",
            "scene_from_source": scene.scene_from_source.tolist(),
            "source_from_scene": np.linalg.inv(scene.scene_from_source).tolist(),
            "scale": scale,
            "rotation": rotation.tolist(),
            "translation": translation.tolist(),
            "origin": origin,
        },
    )


def read_source_from_scene(ply: Path) -> Float64[np.ndarray, "4 4"] | None:
    """Return the transform of a PLY of this package to its source's coordinates, or None without a JSON file.

    Raises:
        ArtifactError: if the JSON belongs to another PLY, or its transform cannot be used.
    """
    path = coordinates_path(ply)
    if not path.is_file():
        return None
    content = read_json(path)
    if not isinstance(content, dict) or "source_from_scene" not in content:
        return None
    if content.get("ply_sha256") != (found := sha256_of_file(ply)):
        raise ArtifactError(
            f"{path} belongs to another PLY than {Path(ply).name}",
            expected=f"sha256 {content.get('ply_sha256')}",
            found=f"sha256 {found}",
            fix="put it beside the PLY that it was written for, or remove it if the PLY is in the "
            "coordinates of the scene's source",
        )
    matrix = np.array(content["source_from_scene"], dtype=np.float64)
    if matrix.shape != (4, 4):
        raise ArtifactError(f"{path}: source_from_scene is not a 4 x 4 matrix", found=f"shape {matrix.shape}")
    return matrix


def write_source_ply(ply: Path, out: Path) -> int:
    """Write the Gaussians of a scene in the coordinates of its source, and return their number.

    Args:
        ply: `gaussians.ply` of a scene, with its JSON file beside it.
        out: 3DGS PLY to write.

    Raises:
        ArtifactError: if the PLY or its JSON file is missing or damaged.
    """
    source_from_scene = read_source_from_scene(ply)
    if source_from_scene is None:
        raise ArtifactError(f"{coordinates_path(ply)} is missing", fix=f"hilsplat run {ply}")
    gaussians = move_gaussians(load_ply(ply), source_from_scene)
    save_ply(out, gaussians)
    return len(gaussians)
