"""Read and write Gaussians as standard 3DGS PLY files, which viewers and other implementations support."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float
from plyfile import PlyData, PlyElement, PlyParseError

from hilsplat.base.artifacts import atomic_path, remake
from hilsplat.base.errors import ArtifactError
from hilsplat.base.files import regular
from hilsplat.splat.gaussians import Gaussians

HEADER_BYTES = 2**14  # number of bytes that are searched for the vertex count


def _names(num_bases: int) -> list[str]:
    """Return the property names in the order of 3DGS; f_rest is stored channel by channel."""
    return [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{k}" for k in range(3)),
        *(f"f_rest_{k}" for k in range(3 * (num_bases - 1))),
        "opacity",
        *(f"scale_{k}" for k in range(3)),
        *(f"rot_{k}" for k in range(4)),
    ]


def save_ply(path: Path, gaussians: Gaussians) -> None:
    """Write a binary little-endian 3DGS PLY atomically; identical Gaussians produce identical bytes.

    Parameters are stored unconverted: log scales, opacity logits, and wxyz quaternions of any length.
    Normals are zero, as in 3DGS.
    """
    n, sh = len(gaussians), gaussians.sh
    columns = (
        gaussians.means,
        np.zeros((n, 3)),
        sh[:, 0],
        sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (sh.shape[1] - 1)),
        gaussians.opacity_logits[:, None],
        gaussians.log_scales,
        gaussians.quats,
    )
    values = np.concatenate(columns, axis=1)
    _require_sound(values, path, "report this fault: the Gaussians were not fitted correctly")
    names = _names(sh.shape[1])
    table = np.ascontiguousarray(values, dtype="<f4").view([(name, "<f4") for name in names]).reshape(n)
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(temporary)


def vertex_count(path: Path) -> int | None:
    """Return the number of Gaussians in a PLY's header; None if unreadable (`load_ply` reports the error)."""
    try:
        with regular(Path(path)).open("rb") as stream:
            header = stream.read(HEADER_BYTES)
    except OSError:
        return None
    found = re.search(rb"^element vertex ([0-9]+)\s*$", header, re.MULTILINE)
    return int(found[1]) if found else None


def load_ply(path: Path, fix: str = "") -> Gaussians:
    """Read a 3DGS PLY from this or another package; the number of f_rest columns determines the degree.

    The file may be binary or ASCII, with properties in any order and of any numeric type. Normals and
    properties not in 3DGS (colours, labels) are ignored. Errors suggest `fix` or, if it is empty, a rerun.

    Raises:
        ArtifactError: if the file is missing, damaged or not a 3DGS PLY, or contains non-finite numbers or
            quaternions that are 0.
    """
    path = Path(path)
    fix = fix or remake(path)
    try:
        vertex = PlyData.read(path)["vertex"]
    except FileNotFoundError as error:
        raise ArtifactError(f"{path} is missing", fix=fix) from error
    except (PlyParseError, KeyError, ValueError, EOFError, OSError, MemoryError) as error:
        raise ArtifactError(f"{path} is not a readable PLY: {error}", fix=fix) from error
    found = {prop.name for prop in vertex.properties}
    if "packed_position" in found:
        raise ArtifactError(f"{path} is a compressed PLY", expected="a plain 3DGS PLY", fix=fix)
    num_rest = sum(name.startswith("f_rest_") for name in found)
    num_bases = num_rest // 3 + 1
    names = [name for name in _names(num_bases) if name not in ("nx", "ny", "nz")]
    missing = [name for name in names if name not in found]
    if missing or num_rest not in (0, 9, 24, 45):
        raise ArtifactError(
            f"{path} is not a 3DGS PLY",
            expected="x y z, f_dc_0..2, 0, 9, 24 or 45 f_rest_*, opacity, scale_0..2, rot_0..3",
            found=f"{num_rest} f_rest columns" + (f"; missing: {', '.join(missing[:5])}" if missing else ""),
            fix=fix,
        )

    values = np.stack([np.asarray(vertex[name], dtype=np.float32) for name in names], axis=1)
    _require_sound(values, path, fix)
    means, dc, rest, opacity, scales, quats = np.split(values, np.cumsum([3, 3, num_rest, 1, 3]), axis=1)
    rest = rest.reshape(len(values), 3, num_bases - 1).transpose(0, 2, 1)
    sh = np.concatenate([dc[:, None], rest], axis=1)
    return Gaussians(*(np.ascontiguousarray(each) for each in (means, scales, quats, opacity[:, 0], sh)))


def _require_sound(values: Float[np.ndarray, "N P"], path: Path, fix: str) -> None:
    """Raise ArtifactError unless all numbers are finite and the last four columns are quaternions."""
    lengths = np.linalg.norm(values[:, -4:].astype(np.float64), axis=1)
    for problem, is_bad in (
        ("contain a non-finite number", ~np.isfinite(values).all(axis=1)),
        ("have no rotation: rot_0..3 are all zero", lengths < 1e-12),
    ):
        if is_bad.any():
            raise ArtifactError(f"{path}: {is_bad.sum()} of {len(values)} Gaussians {problem}", fix=fix)
