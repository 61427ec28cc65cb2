"""Similarity transforms of Gaussians that preserve the appearance of every view."""

import numpy as np
from jaxtyping import Float, Float64
from scipy.special import sph_harm_y

from hilsplat.base.errors import HilsplatError
from hilsplat.base.rotations import are_rotations, multiply, quaternion_of
from hilsplat.splat.gaussians import Gaussians

TOLERANCE = 1e-5
"""Largest deviation of a matrix from a scaled rotation, relative to the scale."""


def decompose(similarity: Float[np.ndarray, "4 4"]) -> tuple[float, Float64[np.ndarray, "3 3"], np.ndarray]:
    """Return the scale, rotation and translation of x -> scale rotation x + translation.

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
            "a transform of coordinates is not a similarity",
            expected="a 4 x 4 matrix of scale times rotation, with a translation and the last row 0 0 0 1",
            found=str(matrix.tolist()),
        )
    return scale, rotation, matrix[:3, 3]


def move_gaussians(gaussians: Gaussians, similarity: Float[np.ndarray, "4 4"]) -> Gaussians:
    """Transform Gaussians to other coordinates; a camera transformed with them sees the same image.

    Means are mapped, scales multiplied, quaternions rotated, and spherical harmonics rotated band by
    band, because they are functions of the direction in the world. Opacities are unchanged.

    Args:
        similarity: b_from_a; the Gaussians are given in a and returned in b.

    Raises:
        HilsplatError: if `similarity` is not a similarity.
    """
    scale, rotation, translation = decompose(similarity)
    means, log_scales, quats, sh = (
        values.astype(np.float64)
        for values in (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.sh)
    )
    by_band = sh_rotation(rotation, gaussians.sh_degree)
    return Gaussians(
        means=_float32(scale * np.einsum("ij,nj->ni", rotation, means) + translation),
        log_scales=_float32(log_scales + np.log(scale)),
        quats=_float32(multiply(quaternion_of(rotation), quats)),
        opacity_logits=gaussians.opacity_logits.copy(),
        sh=_float32(np.einsum("kj,njc->nkc", by_band, sh)),
    )


def _float32(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float32)


def sh_basis(directions: Float64[np.ndarray, "P 3"], degree: int) -> Float64[np.ndarray, "P K"]:
    """Return real spherical harmonics at unit directions, in the order and with the signs of 3DGS.

    Within a band, orders run from -l to l; negative orders are the sines. 3DGS keeps the
    Condon-Shortley sign (-1)^m, which real harmonics often omit.
    """
    x, y, z = directions.T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            value = sph_harm_y(band, abs(order), polar, azimuth)
            if order == 0:
                columns.append(value.real)
            else:
                columns.append(np.sqrt(2) * (value.imag if order < 0 else value.real))
    return np.stack(columns, axis=1)


def sh_rotation(rotation: Float64[np.ndarray, "3 3"], degree: int) -> Float64[np.ndarray, "K K"]:
    """Return the matrix that rotates spherical-harmonics coefficients.

    The rotated colour along R d is the original colour along d. A rotated harmonic stays in its band, so the
    matrix has one block per band. Each block is a least-squares solution over more directions than harmonics,
    exact up to rounding.
    """
    # directions spread over the sphere along a spiral
    number = 64
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
