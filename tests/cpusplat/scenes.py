"""Gaussians and cameras for the tests, as keyword arguments of `rasterization`."""

from typing import Any

import numpy as np

WIDTH, HEIGHT = 51, 37


def random_gaussians(n: int, seed: int = 0, channels: int = 3) -> dict[str, Any]:
    """Gaussians in front of and beside the cameras, a few of them behind; float32."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.uniform((-2, -1.6, -0.3), (2, 1.6, 4), (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(0.02, 0.25, (n, 3)),
        "opacities": 1 / (1 + np.exp(-2 * rng.normal(size=n))),
        "colors": rng.normal(size=(n, channels)),
    }
    return {name: values.astype(np.float32) for name, values in arrays.items()}


def looking_at_origin(position: np.ndarray) -> np.ndarray:
    """World to camera for a camera at `position` that looks at the origin; z is up."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    return viewmat


def two_cameras() -> dict[str, Any]:
    """One camera near the origin, turned and shifted, and one that looks at the origin."""
    turned = np.eye(4)
    c, s = np.cos(0.3), np.sin(0.3)
    turned[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    turned[:3, 3] = (0.1, -0.2, 0.3)
    K = np.array([[50.0, 0, WIDTH / 2 + 1.5], [0, 55, HEIGHT / 2 - 2], [0, 0, 1]])
    viewmats = np.stack([turned, looking_at_origin(np.array([3.0, -2.0, 1.0]))]).astype(np.float32)
    return {"viewmats": viewmats, "Ks": np.stack([K, K]).astype(np.float32), "width": WIDTH, "height": HEIGHT}
