"""Read and write Gaussians as standard 3DGS PLY files, which viewers and other implementations support."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from plyfile import PlyData, PlyElement

from hilsplat.base.artifacts import rebuild_command
from hilsplat.base.atomic import atomic_path
from hilsplat.base.errors import ArtifactError, foreign
from hilsplat.scene.importers.ply_file import read_ply
from hilsplat.splat.gaussians import Gaussians

SATURATED_LOGIT = 16.0  # replaces infinite opacity logits; a float32 sigmoid of 17 is 1
MAX_VALUE = 1e15  # values and scales above it overflow when squared in float32
MAX_UNUSABLE = 0.5  # share of unusable Gaussians above which a PLY is not imported
MIN_JUDGED = 100  # number of Gaussians from which their scales and opacities are recognised as such
UNUSABLE = "contain a non-finite or huge number, or have no rotation (rot_0..3 are zero)"

HARMLESS = re.compile(
    r"n[xyz]|red|green|blue|alpha|[rgb]|id|confidence|quality|intensity|radius|state|flags|face|camera|node_\w+"
    r"|extrinsic|intrinsic|image_size|frame|disparity|color_space|version"
    r"|\w*(normal|label|class|object|instance|segment|identity|obj_dc|ins_feat|semantic|language|feature)\w*"
)
"""Properties and elements of other programs that leave the meaning of 3DGS's properties unchanged."""

REFUSED = {
    r"packed_\w+|chunk|codebook\w*": "is compressed",
    r"\w*(offset|anchor|ancestry)\w*": "contains anchors or levels of detail, not Gaussians",
    r"t|time\w*|t_\w+|\w+_t|scale_t\w*|rot_r\w*|(trbf|motion|omega|velocity|delta)\w*": "changes over time",
    r"beta\w*|sb_\w+|shape\w*|nu": "contains kernels other than Gaussians",
    r"(scale|rot|opacity|f_dc)(_\w+)?|\w*filter\w*": "contains parameters that 3DGS does not have",
}
"""Properties and elements that change the meaning of 3DGS's properties -> what is wrong with the PLY."""

ANTIALIASED = re.compile("SplatRenderMode: *mip", re.IGNORECASE)
"""Comment of Brush, and of gsplat and nerfstudio where they follow it."""


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
        np.zeros((n, 3), np.float32),
        sh[:, 0],
        sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (sh.shape[1] - 1)),
        gaussians.opacity_logits[:, None],
        gaussians.log_scales,
        gaussians.quats,
    )
    values = np.concatenate(columns, axis=1)
    if number := _unusable(values).sum():
        fix = "report this fault: the Gaussians were not fitted correctly"
        raise ArtifactError(f"{path}: {number} of {n} Gaussians {UNUSABLE}", fix=fix)
    names = _names(sh.shape[1])
    table = np.ascontiguousarray(values, dtype="<f4").view([(name, "<f4") for name in names]).reshape(n)
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(temporary)


def load_ply(path: Path) -> Gaussians:
    """Read a 3DGS PLY of this package; errors suggest a rerun.

    Raises:
        ArtifactError: as in `import_ply`, and if anything would be changed or left out.
    """
    fix = rebuild_command(path)
    gaussians, notes, _ = import_ply(path, fix)
    if notes:
        raise ArtifactError(f"{path} is not as this package writes it: {'; '.join(notes)}", fix=fix)
    return gaussians


def import_ply(path: Path, fix: str) -> tuple[Gaussians, list[str], list[str]]:
    """Read a 3DGS PLY of any program; return notes on what was changed or left out, and unknown properties.

    The file may be binary or ASCII, with properties in any order and of any float type. `filter_3D`, the
    smoothing filter of Mip-Splatting and GOF, is applied. Infinite opacity logits are clamped, and other
    unusable Gaussians are left out.

    Raises:
        ArtifactError: if the file is missing, damaged or not a 3DGS PLY, contains anything in `REFUSED`, more
            than `MAX_UNUSABLE` of its Gaussians are unusable, or its scales or opacities are plain numbers.
    """
    if not path.exists():
        raise ArtifactError(f"{path} is missing", fix=fix)
    values, others, notes = _values(path, fix)
    infinite = np.isinf(values[:, -8])
    if infinite.any():
        values[infinite, -8] = np.copysign(SATURATED_LOGIT, values[infinite, -8])
        notes.append(f"{infinite.sum()} infinite opacities are clamped")
    unusable = _unusable(values)
    if unusable.any():
        notes.append(f"left out: {unusable.sum()} of {len(values)} Gaussians {UNUSABLE}")
    if unusable.sum() > MAX_UNUSABLE * len(values):
        raise ArtifactError(f"{path}: {notes[-1].removeprefix('left out: ')}", fix=fix)
    values = values[~unusable] if unusable.any() else values
    _require_parameters(path, values, fix)
    unknown = {re.sub(r"\d+$", "*", name) for name in others if not HARMLESS.fullmatch(name)}
    return _gaussians(values), notes, sorted(unknown)


def _values(path: Path, fix: str) -> tuple[Float32[np.ndarray, "N P"], list[str], list[str]]:
    """Read 3DGS's properties (`_columns`) and the names of others; also return notes."""
    notes = []
    with foreign(path, ArtifactError, expected="a 3DGS PLY", fix=fix), np.errstate(over="ignore"):
        ply = read_ply(path)
        vertex = ply["vertex"]
        kinds = {prop.name: vertex.data.dtype[prop.name].kind for prop in vertex.properties}
        others = sorted({*kinds, *(element.name for element in ply)} - {*_names(16), "filter_3D", "vertex"})
        for pattern, problem in REFUSED.items():
            if refused := [name for name in others if re.fullmatch(pattern, name, re.IGNORECASE)]:
                raise ArtifactError(f"{path} {problem}", found=", ".join(refused[:5]), fix=fix)
        names = _columns(path, kinds, fix)
        values = np.empty((len(vertex.data), len(names)), np.float32)
        for column, name in enumerate(names):
            values[:, column] = vertex[name]
        if "filter_3D" in kinds:
            _smooth(values, np.asarray(vertex["filter_3D"], np.float64))
            notes.append("filter_3D was applied to scales and opacities")
        if any(ANTIALIASED.fullmatch(comment.strip()) for comment in ply.comments):
            notes.append("they were trained with antialiasing, which is not applied: thin parts look thicker")
    return values, others, notes


def _columns(path: Path, kinds: dict[str, str], fix: str) -> list[str]:
    """Return 3DGS's properties, without normals; the number of f_rest columns determines the degree."""
    num_rest = sum(name.startswith("f_rest_") for name in kinds)
    names = [name for name in _names(num_rest // 3 + 1) if name not in ("nx", "ny", "nz")]
    missing = [name for name in names if kinds.get(name) != "f"]  # integers are indices into a codebook
    if missing or num_rest not in (0, 9, 24, 45):
        what = "contains flat disks (2DGS)" if missing == ["scale_2"] else "is not a 3DGS PLY"
        found = f"; missing, or not floats: {', '.join(missing[:5])}" if missing else ""
        raise ArtifactError(
            f"{path} {what}",
            expected="floats x y z, f_dc_0..2, 0, 9, 24 or 45 f_rest_*, opacity, scale_0..2, rot_0..3",
            found=f"{num_rest} f_rest columns{found}",
            fix=fix,
        )
    return names


def _require_parameters(path: Path, values: Float32[np.ndarray, "N P"], fix: str) -> None:
    """Raise ArtifactError for scales or opacities as scripts write them, without logarithm or logit.

    Trained scales have a long tail towards 0, so if all are positive logarithms, most are far above 1.
    """
    if len(values) < MIN_JUDGED:
        return
    opacities, scales = values[:, -8], values[:, -7:-4]
    has_alphas = 0 <= opacities.min() < opacities.max() <= 1
    if has_alphas or (scales.min() > 0 and np.median(scales) < 1):
        limits = *(scales.min(), scales.max()), *(opacities.min(), opacities.max())
        raise ArtifactError(
            f"{path} does not contain the parameters of 3DGS",
            expected="natural logarithms of scales, and logits of opacities",
            found="scale_* from {:.3g} to {:.3g}, opacity from {:.3g} to {:.3g}".format(*limits),
            fix=fix,
        )


def _gaussians(values: Float32[np.ndarray, "N P"]) -> Gaussians:
    num_others = (values.shape[1] - 14) // 3  # harmonics besides the constant one
    sh = np.empty((len(values), 1 + num_others, 3), np.float32)
    sh[:, 0] = values[:, 3:6]
    for channel in range(3):
        sh[:, 1:, channel] = values[:, 6 + channel * num_others :][:, :num_others]
    columns = values[:, :3], values[:, -7:-4], values[:, -4:], values[:, -8], sh
    return Gaussians(*map(np.ascontiguousarray, columns))


def _smooth(values: Float32[np.ndarray, "N P"], filter_3d: Float64[np.ndarray, " N"]) -> None:
    """Replace s by sqrt(s^2 + f^2) =: s' and o by o sqrt(prod s^2 / prod s'^2) (Mip-Splatting, Eq. 9)."""
    log_scales, logits = values[:, -7:-4].astype(np.float64), values[:, -8].astype(np.float64)
    with np.errstate(all="ignore"):  # f = 0 and infinite logits are valid
        smooth = np.logaddexp(2 * log_scales, 2 * np.log(np.abs(filter_3d))[:, None]) / 2
        log_opacity = (log_scales - smooth).sum(axis=1) - np.logaddexp(0, -logits)
        values[:, -7:-4], values[:, -8] = smooth, log_opacity - np.log(-np.expm1(log_opacity))


def _unusable(values: Float[np.ndarray, "N P"]) -> Bool[np.ndarray, " N"]:
    """Return which Gaussians have a value or scale that is not finite or too large, or no rotation."""
    # extremes instead of magnitudes, which would need as much memory as the values; NaN compares as false
    sound = (values.max(axis=1) < MAX_VALUE) & (values.min(axis=1) > -MAX_VALUE)
    sound &= (values[:, -7:-4] < np.log(MAX_VALUE)).all(axis=1)
    return ~sound | (np.linalg.norm(values[:, -4:].astype(np.float64), axis=1) < 1e-12)
