"""Import and export of Gaussians in the coordinates of a scene's source, and the JSON file between both."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.artifacts import read_json, sha256_of_file, write_json
from hilsplat.base.errors import ArtifactError
from hilsplat.scene.importers.nerfstudio import source_from_dataparser
from hilsplat.scene.scene import Scene
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply, save_ply
from hilsplat.splat.similarity import decompose, move_gaussians

logger = logging.getLogger(__name__)

AXES = "right-handed; cameras in OpenCV axes (x right, y down, z forward)"

FIX = "export it again as an uncompressed 3DGS PLY, or correct column gaussians of the scene sheet"


def write_coordinates(ply: Path, scene: Scene, gaussians: Gaussians, origin: dict[str, Any]) -> None:
    """Write the transform between a PLY's coordinates, which are the scene's, and those of its source.

    The source of the poses is an imported COLMAP model or transforms.json, or our own structure from motion,
    whose coordinates are not recorded elsewhere.

    The JSON is beside the PLY and applies to no other file, so it contains the PLY's digest.
    """
    scale, rotation, translation = decompose(scene.scene_from_source)
    registration = read_json(scene.folder / "registration.json")
    write_json(
        ply.with_suffix(".json"),
        {
            "scene": scene.name,
            "ply": ply.name,
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
    path = ply.with_suffix(".json")
    if not path.is_file():
        return None
    content = read_json(path)
    if not isinstance(content, dict) or "source_from_scene" not in content:
        return None
    if content.get("ply_sha256") != (found := sha256_of_file(ply)):
        raise ArtifactError(
            f"{path} belongs to another PLY than {ply.name}",
            expected=f"sha256 {content.get('ply_sha256')}",
            found=f"sha256 {found}",
            fix="put it beside the PLY that it was written for, or remove it if the PLY is in the "
            "coordinates of the scene's source",
        )
    matrix = np.array(content["source_from_scene"], dtype=np.float64)
    if matrix.shape != (4, 4):
        raise ArtifactError(f"{path}: source_from_scene is not a 4 x 4 matrix", found=f"shape {matrix.shape}")
    return matrix


def import_gaussians(
    ply: Path, scene: Scene, dataparser: Path | None = None, transforms: Path | None = None
) -> tuple[Gaussians, dict[str, Any]]:
    """Read a 3DGS PLY, by default in the coordinates of the scene's source poses.

    A PLY of this package is in its scene's coordinates instead; it is first moved to the source's by the
    transform in the JSON file beside it. A nerfstudio PLY is moved by the transform of its data parser.

    Args:
        dataparser: nerfstudio's `dataparser_transforms.json`, if the PLY is in its training coordinates.
        transforms: `transforms.json` with the source's poses, required by `dataparser`.

    Returns:
        The Gaussians in the scene's coordinates, and their origin for the report.

    Raises:
        ArtifactError: if the file cannot be used.
    """
    gaussians = load_ply(ply, fix=FIX)
    if len(gaussians) == 0:
        raise ArtifactError(f"{ply} does not hold any Gaussians", fix=FIX)
    lengths = np.linalg.norm(gaussians.quats.astype(np.float64), axis=1)
    if (zero := int((lengths < 1e-12).sum())) > 0:
        raise ArtifactError(
            f"{ply}: {zero} of {len(gaussians)} Gaussians have no rotation: rot_0..3 are all zero", fix=FIX
        )
    source_from_ply = read_source_from_scene(ply)
    moved = "in the coordinates of the scene's source"
    transform = scene.scene_from_source
    if source_from_ply is not None:
        transform = transform @ source_from_ply
        moved = "in the coordinates that the JSON file beside it describes"
    elif dataparser is not None:
        transform = transform @ source_from_dataparser(dataparser, transforms)
        moved = f"in nerfstudio's training coordinates, by {dataparser.name}"
    logger.info("%s: %d Gaussians of %s, %s", scene.name, len(gaussians), ply, moved)
    origin = {
        "kind": "imported",
        "file": ply.name,  # its folder is in the provenance record
        "sha256": sha256_of_file(ply),
        "taken_as": moved,
        "scene_from_ply": np.asarray(transform).tolist(),
    }
    return move_gaussians(gaussians, transform), origin


def write_source_ply(ply: Path, out: Path) -> int:
    """Write the Gaussians of a scene in the coordinates of its source, and return their number.

    Args:
        ply: `gaussians.ply` of a scene, with its JSON file beside it.

    Raises:
        ArtifactError: if the PLY or its JSON file is missing or damaged.
    """
    source_from_scene = read_source_from_scene(ply)
    if source_from_scene is None:
        raise ArtifactError(f"{ply.with_suffix('.json')} is missing", fix=f"hilsplat run {ply}")
    gaussians = move_gaussians(load_ply(ply), source_from_scene)
    save_ply(out, gaussians)
    return len(gaussians)
