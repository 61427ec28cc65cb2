"""Similarity transform between two reconstructions with shared cameras: true and estimated poses."""

import numpy as np
from jaxtyping import Float64

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.scene.cameras import Cameras

MIN_SHARED = 3


def scene_from_true(true: Cameras, found: Cameras) -> tuple[Float64[np.ndarray, "4 4"], float]:
    """Return the similarity that maps ground-truth to scene coordinates, and the median camera error.

    Cameras are matched by name. The rotation is the mean of those between the cameras' orientations
    (orthogonal Procrustes), so that it is determined even for cameras on a straight line; scale and offset
    are least squares over the centres. The error is the distance of estimated from true centres, in the units
    of the ground truth.

    Raises:
        MisalignedArtifactError: fewer than three cameras are shared, or all have the same position.
    """
    known = set(true.names)
    shared = [name for name in found.names if name in known]
    if len(shared) < MIN_SHARED:
        raise MisalignedArtifactError(
            "the ground-truth cameras and the scene's cameras belong to different images",
            expected=f"at least {MIN_SHARED} shared names",
            found=f"{len(shared)}",
            fix="evaluate the scene with its own ground-truth folder",
        )
    turns = sum(found[name].cam_from_world[:3, :3].T @ true[name].cam_from_world[:3, :3] for name in shared)
    left, _, right = np.linalg.svd(turns)
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    here = np.stack([true[name].centre for name in shared])
    there = np.stack([found[name].centre for name in shared])
    here_mean, there_mean = here.mean(axis=0), there.mean(axis=0)
    turned = (here - here_mean) @ rotation.T
    spread = np.square(turned).sum()
    scale = (turned * (there - there_mean)).sum() / spread if spread > 0 else 0.0
    if scale <= 0:
        raise MisalignedArtifactError(
            "no similarity maps the ground-truth cameras to the scene's",
            expected="camera centres with the same arrangement",
            found="centres in one place, or mirrored",
            fix="check registration.png; the poses have probably failed",
        )
    transform = np.eye(4)
    transform[:3, :3] = scale * rotation
    transform[:3, 3] = there_mean - scale * rotation @ here_mean
    apart = np.linalg.norm(here @ transform[:3, :3].T + transform[:3, 3] - there, axis=1)
    return transform, float(np.median(apart) / scale)
