"""Quaternions (wxyz) and rotation matrices: the one place that knows how they belong together."""

from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float64

from hilsplat.base.compiled import compiled

RIGID_TOLERANCE = 1e-3
"""How far R R' of a camera may be from the identity: poses come as text with four digits."""


@compiled(inline="always")
@no_type_check
def matrix_entries(w, x, y, z):
    """Rotation matrix of a unit quaternion, row by row: nine numbers.

    Inlined into compiled loops; `rotation_matrices` runs the same lines on arrays.
    """
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


def unit_quaternions(quats: Float[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 4"]:
    """Quaternions of any length but 0, scaled to length 1."""
    quats = quats.astype(np.float64)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def rotation_matrices(quats: Float[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 3 3"]:
    """Rotation matrices of quaternions of any length but 0; `matrices[i] @ v` turns v by `quats[i]`."""
    entries: Any = matrix_entries.py_func(*unit_quaternions(quats).T)
    return np.stack(entries, axis=1).reshape(-1, 3, 3)


def quaternion_of(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 4"]:
    """Unit quaternion of a rotation matrix; of the two that turn alike, scipy's choice."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])


def rotate(
    quats: Float64[np.ndarray, "N 4"], vectors: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Turn each vector by its unit quaternion."""
    # v + 2 w (u x v) + 2 u x (u x v)
    u = quats[:, 1:]
    turned = np.cross(u, vectors)
    return vectors + 2 * (quats[:, :1] * turned + np.cross(u, turned))


def multiply(
    left: Float64[np.ndarray, " 4"], right: Float64[np.ndarray, "N 4"]
) -> Float64[np.ndarray, "N 4"]:
    """Quaternions that turn first by `right`, then by `left`; lengths multiply."""
    w, u = left[0], left[1:]
    scalar = w * right[:, 0] - right[:, 1:] @ u
    vector = w * right[:, 1:] + right[:, :1] * u + np.cross(u, right[:, 1:])
    return np.concatenate([scalar[:, None], vector], axis=1)


def are_rotations(matrices: Float[np.ndarray, "*n 3 3"], tolerance: float) -> Bool[np.ndarray, "*n"]:
    """Whether each matrix is a rotation: finite, orthogonal, and no mirror.

    Args:
        tolerance: how far an entry of R R' may be from that of the identity.
    """
    finite = np.isfinite(matrices).all(axis=(-2, -1))
    safe = np.where(finite[..., None, None], matrices, 0.0)
    distance = np.abs(safe @ np.swapaxes(safe, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    return np.asarray(finite & (distance <= tolerance) & (np.linalg.det(safe) > 0))
