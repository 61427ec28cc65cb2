"""Find the Gaussian of each labelled point (mesh vertex or lidar return), and classify its feature."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int32, Int64

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.splat.gaussians import Gaussians

Mode = Literal["frozen", "nearest"]

OPACITY_MIN = 0.1
"""Gaussians below this opacity count as transparent; OpenGaussian excludes them from the evaluation."""

CHUNK_POINTS = 65536
"""Number of points classified at once; bounds memory use."""


def gaussians_of_points(
    points: Float[np.ndarray, "P 3"], gaussians: Gaussians, mode: Mode, threads: int = 1
) -> tuple[Int64[np.ndarray, " P"], Bool[np.ndarray, " P"]]:
    """Return the Gaussian of each point, and whether the point is scored; positions are in scene units.

    `nearest` uses the nearest Gaussian that is opaque enough. The search tree breaks ties between equidistant
    Gaussians deterministically, for the same input and any number of threads. `frozen` uses the Gaussian with
    the point's index, so the fit must not have moved, split or dropped any. As in OpenGaussian's
    `scripts/eval_scannet.py`, points whose Gaussian is transparent are then not scored.

    Raises:
        MisalignedArtifactError: no Gaussian is opaque enough, or under `frozen`, the numbers of Gaussians and
            points differ.
    """
    opacities = gaussians.opacities
    if mode == "frozen":
        if len(opacities) != len(points):
            raise MisalignedArtifactError(
                "the Gaussians do not correspond to the ground-truth points",
                expected=f"{len(points)} Gaussians, one per point",
                found=len(opacities),
                fix="fit with frozen points, or use mode nearest",
            )
        return np.arange(len(points), dtype=np.int64), opacities >= OPACITY_MIN
    opaque = np.flatnonzero(opacities >= OPACITY_MIN)
    if not opaque.size:
        raise MisalignedArtifactError(
            "no Gaussian is opaque enough to label a point",
            expected=f"an opacity of at least {OPACITY_MIN}",
            found=f"{len(opacities)} Gaussians, all below",
            fix="check gaussians.ply; the fit has probably failed",
        )
    from scipy.spatial import cKDTree  # importing takes 0.2 s and is needed only for points

    tree = cKDTree(gaussians.means[opaque].astype(float))
    _, place = tree.query(points.astype(float), workers=threads)
    return opaque[place].astype(np.int64), np.ones(len(points), dtype=bool)


def classify(features: Float[np.ndarray, "P D"], texts: Float[np.ndarray, "K D"]) -> Int32[np.ndarray, " P"]:
    """Return labels 1 .. K by the largest cosine with the class texts (unit vectors); the first wins ties.

    Canonical phrases and a class "other" are not used. Departs: OpenGaussian's argmax assigns points without
    a feature (all zero) to its first class, wall; here they get label 0, a miss.
    """
    labels = np.zeros(len(features), dtype=np.int32)
    for start in range(0, len(features), CHUNK_POINTS):
        rows = slice(start, start + CHUNK_POINTS)
        # The norm of a feature does not change which cosine is largest.
        scores = features[rows] @ texts.T
        labels[rows] = np.where(scores.any(axis=1), scores.argmax(axis=1) + 1, 0)
    return labels
