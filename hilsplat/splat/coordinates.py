"""Coordinates of Gaussians: similarity transforms, and import and export in a source's coordinates."""

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.special import sph_harm_y

from hilsplat.base.artifacts import read_json, run_command, write_json
from hilsplat.base.errors import ArtifactError, HilsplatError, SceneError, foreign
from hilsplat.base.lineage import require_as_written, require_made_from, sha256_of_file
from hilsplat.base.rotations import are_rotations, multiply, quaternion_of
from hilsplat.scene.layouts import ply_header, read_json_object
from hilsplat.scene.posed_images import rigid_pose
from hilsplat.scene.scene import Scene
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.ply import import_ply, load_ply, save_ply

logger = logging.getLogger(__name__)

FIX = (
    "export it again as an uncompressed 3DGS PLY (SuperSplat converts other formats), or correct the "
    "gaussians column of the scene sheet"
)
COPY_AGAIN = "copy it again from nerfstudio"
KEY = "source_from_scene"
TOLERANCE = 1e-5  # maximum deviation of a matrix from a scaled rotation, relative to the scale
MOVED_TOGETHER = 2**16  # number of Gaussians that are moved in float64 at once, to save memory
BEFORE_APPLIED_TRANSFORM = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
"""Transform of COLMAP coordinates by `ns-process-data` versions that do not record `applied_transform`."""


def decompose(similarity: Float[np.ndarray, "4 4"]) -> tuple[float, Float64[np.ndarray, "3 3"], np.ndarray]:
    """Return the scale, rotation and translation of the map x -> scale * rotation @ x + translation.

    Raises:
        HilsplatError: if the matrix mirrors, shears or projects, or contains non-finite numbers.
    """
    matrix = np.asarray(similarity, dtype=np.float64)
    linear = matrix[:3, :3]
    determinant = np.linalg.det(linear) if np.isfinite(matrix).all() else 0.0
    scale = float(np.cbrt(determinant))
    rotation = linear / scale if scale > 0 else np.zeros((3, 3))
    if not are_rotations(rotation, TOLERANCE) or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise HilsplatError(
            "a coordinate transform is not a similarity",
            expected="a 4 x 4 matrix: scale times rotation, a translation, and the last row 0 0 0 1",
            found=str(matrix.tolist()),
        )
    return scale, rotation, matrix[:3, 3]


def move_gaussians(gaussians: Gaussians, similarity: Float[np.ndarray, "4 4"]) -> Gaussians:
    """Transform Gaussians from coordinate system a to b; `similarity` is b_from_a.

    A camera transformed in the same way renders the same image. Spherical harmonics are rotated too, because
    they are functions of the world direction. The errors are those of `decompose`.
    """
    scale, rotation, translation = decompose(similarity)
    g, turn = gaussians, sh_rotation(rotation, gaussians.sh_degree)
    moved = Gaussians(*(np.empty_like(getattr(g, name), order="C") for name in FIELDS))
    moved.opacity_logits[:] = g.opacity_logits
    for start in range(0, len(g), MOVED_TOGETHER):
        rows = slice(start, start + MOVED_TOGETHER)
        means, log_scales, quats, sh = (
            a[rows].astype(np.float64) for a in (g.means, g.log_scales, g.quats, g.sh)
        )
        moved.means[rows] = scale * np.einsum("ij,nj->ni", rotation, means) + translation
        moved.log_scales[rows] = log_scales + np.log(scale)
        moved.quats[rows] = multiply(quaternion_of(rotation), quats)
        moved.sh[rows] = np.einsum("kj,njc->nkc", turn, sh)
    return moved


def sh_basis(directions: Float64[np.ndarray, "P 3"], degree: int) -> Float64[np.ndarray, "P K"]:
    """Evaluate real spherical harmonics for unit directions, with the order and signs of 3DGS.

    Within band l, orders run from -l to l; negative orders are the sine terms. 3DGS keeps the Condon-Shortley
    sign (-1)^m, which real harmonics often omit.
    """
    x, y, z = directions.T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            value = sph_harm_y(band, abs(order), polar, azimuth)
            part = value.imag if order < 0 else value.real
            columns.append(np.sqrt(2) * part if order else part)
    return np.stack(columns, axis=1)


def sh_rotation(rotation: Float64[np.ndarray, "3 3"], degree: int) -> Float64[np.ndarray, "K K"]:
    """Return the matrix that rotates spherical-harmonics coefficients.

    The rotated colour along R d is the original colour along d. A rotated harmonic stays in its band, so the
    matrix has one block per band. Each block is fitted by least squares to more directions than harmonics;
    it is exact up to rounding.
    """
    number = 64  # directions spread over the sphere along a spiral
    height = 1 - (2 * np.arange(number) + 1) / number
    angle = np.arange(number) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    turned = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    before = sh_basis(turned @ rotation, degree)  # rows are R^T d
    after = sh_basis(turned, degree)
    out = np.zeros(((degree + 1) ** 2,) * 2)
    for band in range(degree + 1):
        block = slice(band**2, (band + 1) ** 2)
        out[block, block] = np.linalg.lstsq(after[:, block], before[:, block], rcond=None)[0]
    return out


def write_coordinates(ply: Path, scene: Scene, gaussians: Gaussians, origin: dict[str, Any]) -> None:
    """Write the transform between the scene's coordinates, which the PLY uses, and those of its source.

    The JSON file beside the PLY contains the PLY's digest, because it is valid for that PLY only. It is the
    only record of the coordinates used by our own structure from motion.
    """
    scale, rotation, translation = decompose(scene.scene_from_source)
    write_json(
        ply.with_suffix(".json"),
        {
            "scene": scene.name,
            "ply": ply.name,
            "ply_sha256": sha256_of_file(ply),
            "gaussians": len(gaussians),
            "sh_degree": gaussians.sh_degree,
            "unit": scene.unit,
            "axes": "right-handed; cameras in OpenCV axes (x right, y down, z forward)",
            "source": read_json(scene.folder / "registration.json")["poses"],
            "convention": "x_scene = scene_from_source @ [x_source, 1]",
            "scene_from_source": scene.scene_from_source.tolist(),
            KEY: np.linalg.inv(scene.scene_from_source).tolist(),
            "scale": scale,
            "rotation": rotation.tolist(),
            "translation": translation.tolist(),
            "origin": origin,
        },
    )


def read_source_from_scene(ply: Path) -> Float64[np.ndarray, "4 4"] | None:
    """Return the transform from a PLY's coordinates to its source's.

    It is in the JSON file beside the PLY, or in a comment of its header (`source_comments`). None if neither
    has it.
    """
    path = ply.with_suffix(".json")
    content = read_json(path) if path.is_file() else None
    if not isinstance(content, dict) or KEY not in content:
        return _commented(ply)
    require_as_written(path, sha256_of_file(path))
    fix = "move it next to its PLY, or remove it if this PLY is in the coordinates of the scene's source"
    require_made_from(path, ply, str(content.get("ply_sha256")), sha256_of_file(ply), fix)
    matrix = np.array(content[KEY], dtype=np.float64)
    if matrix.shape != (4, 4):
        raise ArtifactError(f"{path}: {KEY} is not a 4 x 4 matrix", found=f"shape {matrix.shape}")
    return matrix


def source_comments(ply: Path) -> list[str]:
    """Return the comment that states the coordinates of copies of a scene's PLY; none if they are unknown."""
    matrix = read_source_from_scene(ply)
    return [] if matrix is None else [" ".join([KEY, *map(repr, matrix.ravel().tolist())])]


def _commented(ply: Path) -> Float64[np.ndarray, "4 4"] | None:
    match = re.search(rf"^comment {KEY} (.*)$".encode(), ply_header(ply), re.MULTILINE)
    if match is None:
        return None
    with foreign(f"{ply}, comment {KEY}", ArtifactError, expected="16 numbers", fix=FIX):
        return np.array(match[1].split(), dtype=np.float64).reshape(4, 4)


def source_from_dataparser(dataparser: Path, transforms: Path | None) -> Float64[np.ndarray, "4 4"]:
    """Return the similarity from nerfstudio's training coordinates to those of the source's poses.

    `dataparser_transforms.json` maps original coordinates, usually COLMAP's, to training coordinates:
    `x_training = scale * (transform @ [x_original, 1])`. The poses in `transforms.json` are in a third
    coordinate system, which `applied_transform` and `applied_scale` in that file relate to the original one.
    If `transforms` is None, the poses are those of a COLMAP model.
    """
    content = read_json_object(dataparser, COPY_AGAIN)
    applied, applied_scale = np.eye(4), 1.0
    if transforms is not None:
        saved = read_json_object(transforms, COPY_AGAIN)
        if "applied_transform" in saved:
            applied = _matrix(transforms, "applied_transform", saved)
        elif (transforms.parent / "colmap/sparse/0").is_dir():
            applied[:3] = BEFORE_APPLIED_TRANSFORM
        applied_scale = _scale(transforms, "applied_scale", {"applied_scale": 1.0, **saved})
    training_from_source = _matrix(dataparser, "transform", content) @ np.linalg.inv(applied)
    training_from_source[:3] *= _scale(dataparser, "scale", content) / applied_scale
    return np.linalg.inv(training_from_source)


def _matrix(path: Path, key: str, content: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    with foreign(f"{path}: {key}", fix=COPY_AGAIN):
        return rigid_pose(np.array(content[key], np.float64), f"{path}: {key}")


def _scale(path: Path, key: str, content: dict[str, Any]) -> float:
    value = content.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value < float("inf"):
        raise SceneError(f"{path}: {key} is not a positive number", found=repr(value)[:80])
    return float(value)


def read_gaussians(ply: Path) -> tuple[Gaussians, list[str]]:
    """Read another program's PLY; return notes on what was changed and left out (`import_ply`)."""
    gaussians, notes, unknown = import_ply(ply, FIX)
    if unknown:
        notes.append(f"unknown properties are not used: {', '.join(unknown)}")
    if len(gaussians) == 0:
        raise ArtifactError(f"{ply} contains no Gaussians", fix=FIX)
    return gaussians, notes


def source_from_ply(
    ply: Path, dataparser: Path | None, transforms: Path | None
) -> tuple[Float64[np.ndarray, "4 4"], str]:
    """Return the transform from a PLY's coordinates to those of the source's poses, and what it is based on.

    A PLY written by this package is transformed with the JSON file beside it, or with the comment in its
    header. A PLY in nerfstudio's training coordinates needs its `dataparser_transforms.json`, and the
    `transforms.json` that contains the source's poses.
    """
    if (recorded := read_source_from_scene(ply)) is not None:
        return recorded, "in the coordinates that its header or the JSON file beside it describes"
    if dataparser is not None:
        matrix = source_from_dataparser(dataparser, transforms)
        return matrix, f"in nerfstudio's training coordinates, from {dataparser.name}"
    return np.eye(4), "in the coordinates of the scene's source"


def import_gaussians(
    ply: Path, scene: Scene, dataparser: Path | None = None, transforms: Path | None = None
) -> tuple[Gaussians, dict[str, Any]]:
    """Read a 3DGS PLY, whose coordinates are those that `source_from_ply` finds.

    Returns:
        The Gaussians in the scene's coordinates, and their origin for the report.

    Raises:
        ArtifactError: if the file cannot be used.
    """
    gaussians, notes = read_gaussians(ply)
    matrix, moved = source_from_ply(ply, dataparser, transforms)
    transform = scene.scene_from_source @ matrix
    logger.info("%s: %d Gaussians from %s, %s", scene.name, len(gaussians), ply, "; ".join([moved, *notes]))
    origin = {
        "kind": "imported",
        "file": ply.name,  # its folder is in the provenance record
        "sha256": sha256_of_file(ply),
        "taken_as": moved,
        "notes": notes,
        "scene_from_ply": transform.tolist(),
    }
    return move_gaussians(gaussians, transform), origin


def write_source_ply(ply: Path, out: Path, rows: Int64[np.ndarray, " g"] | None = None) -> int:
    """Write a scene's Gaussians in the coordinates of the scene's source, and return their number.

    Args:
        rows: the Gaussians to write; None writes all.
    """
    source_from_scene = read_source_from_scene(ply)
    if source_from_scene is None:
        raise ArtifactError(f"{ply.with_suffix('.json')} is missing", fix=run_command(ply))
    gaussians = load_ply(ply)
    if rows is not None:
        gaussians = Gaussians(*(getattr(gaussians, name)[rows] for name in FIELDS))
    gaussians = move_gaussians(gaussians, source_from_scene)
    save_ply(out, gaussians)
    return len(gaussians)
