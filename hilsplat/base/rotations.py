"""Quaternions (wxyz), rotation matrices and conversions between them."""

import numpy as np
from jaxtyping import Bool, Float, Float64

RIGID_TOLERANCE = 1e-3
"""Maximum deviation of a camera's R R' from the identity; poses in text files may have only four digits."""


def unit_quaternions(quats: Float[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 4"]:
    """Scale quaternions of any nonzero length to length 1."""
    quats = quats.astype(np.float64)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def quaternion_of(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 4"]:
    """Convert a rotation matrix to a unit quaternion; scipy chooses the sign."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


def rotate(
    quats: Float64[np.ndarray, "N 4"], vectors: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    # v + 2 w (u x v) + 2 u x (u x v)
    u = quats[:, 1:]
    turned = np.cross(u, vectors)
    return vectors + 2 * (quats[:, :1] * turned + np.cross(u, turned))


def multiply(
    left: Float64[np.ndarray, " 4"], right: Float64[np.ndarray, "N 4"]
) -> Float64[np.ndarray, "N 4"]:
    """Compose rotations: first `right`, then `left`; their lengths are multiplied."""
    w, u = left[0], left[1:]
    scalar = w * right[:, 0] - right[:, 1:] @ u
    vector = w * right[:, 1:] + right[:, :1] * u + np.cross(u, right[:, 1:])
    return np.concatenate([scalar[:, None], vector], axis=1)


def are_rotations(matrices: Float[np.ndarray, "*n 3 3"], tolerance: float) -> Bool[np.ndarray, "*n"]:
    """Return whether each matrix is a rotation: finite, not a reflection, and R R' close to the identity."""
    finite = np.isfinite(matrices).all(axis=(-2, -1))
    safe = np.where(finite[..., None, None], matrices, 0.0)
    distance = np.abs(safe @ np.swapaxes(safe, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    return np.asarray(finite & (distance <= tolerance) & (np.linalg.det(safe) > 0))
