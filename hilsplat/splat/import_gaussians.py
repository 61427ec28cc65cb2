"""Existing Gaussians for a scene: read, checked and moved into the scene's coordinates."""

import logging
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.artifacts import sha256_of_file
from hilsplat.base.errors import ArtifactError
from hilsplat.scene.importers.nerfstudio import source_from_dataparser
from hilsplat.scene.scene import Scene
from hilsplat.splat.coordinates import read_source_from_scene
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply
from hilsplat.splat.similarity import move_gaussians

logger = logging.getLogger(__name__)

FIX = "export it again as an uncompressed 3DGS PLY, or correct column gaussians of the scene sheet"


def import_gaussians(
    ply: Path, scene: Scene, dataparser: Path | None = None, transforms: Path | None = None
) -> tuple[Gaussians, dict[str, Any]]:
    """Read a 3DGS PLY, by default in the coordinates of the scene's source poses.

    A PLY of this package is in its scene's coordinates instead; it is first moved to the source's by the
    transform in the JSON file beside it. A nerfstudio PLY is moved by the transform of its data parser.

    Args:
        ply: 3DGS PLY to read.
        scene: scene that the Gaussians belong to.
        dataparser: nerfstudio's `dataparser_transforms.json`, if the PLY is in its training coordinates.
        transforms: `transforms.json` with the source's poses, required by `dataparser`.

    Returns:
        The Gaussians in the scene's coordinates, and their origin for the report.

    Raises:
        ArtifactError: if the file cannot be used.
    """
    ply = Path(ply)
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
