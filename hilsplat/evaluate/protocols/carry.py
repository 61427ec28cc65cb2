"""Transfer labels and features from Gaussians to labelled points: mesh vertices and lidar returns.

| mode | source of a point's label or feature |
|---|---|
| `frozen` | the Gaussian with the point's index, fitted without moving (OpenGaussian) |
| `nearest` | the nearest Gaussian that is opaque enough |
| `vote` | an opacity-weighted vote of the k nearest Gaussians within a radius; nothing if there are none |
| `density` | the mean of the k nearest Gaussians, weighted by opacity times Gaussian falloff at the point |

Scores depend on the mode, so every row names it. The search tree breaks ties between equidistant Gaussians
deterministically, for the same input and any number of threads.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int32, Int64

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.rotations import rotation_matrices
from hilsplat.splat.gaussians import Gaussians

Mode = Literal["frozen", "nearest", "vote", "density"]

OPACITY_MIN = 0.1
"""Gaussians below this opacity count as transparent; OpenGaussian excludes them from the evaluation."""

NEIGHBOURS = {"nearest": 1, "vote": 5, "density": 8}
"""Number of Gaussians assigned to each point, by mode."""

CHUNK_POINTS = 65536
"""Number of points processed at once; bounds memory use."""


@dataclass(frozen=True)
class CarriedPoints:
    """Gaussians assigned to each of P points, with weights."""

    mode: str  # name used in rows, with departures from the defaults
    index: Int64[np.ndarray, "P k"]  # undefined where the weight is 0
    weight: Float64[np.ndarray, "P k"]  # non-negative, sum 1; all 0 if no Gaussian is assigned to the point
    is_scored: Bool[np.ndarray, " P"]  # False for points that the mode excludes from the evaluation

    def labels(self, of_gaussian: Int[np.ndarray, " N"]) -> Int32[np.ndarray, " P"]:
        """Return the label with the largest total weight among each point's Gaussians; the lowest wins ties.

        Label 0 means no label and has no weight; a point whose Gaussians are all unlabelled gets 0.
        """
        result = np.zeros(len(self.index), dtype=np.int32)
        for rows in _chunks(len(self.index)):
            labels = of_gaussian[self.index[rows]]
            weight = np.where(labels > 0, self.weight[rows], 0.0)
            same = labels[:, :, None] == labels[:, None, :]
            votes = (same * weight[:, None, :]).sum(axis=2)
            best = votes.max(axis=1)
            # Sums of the same numbers in different order may differ in the last bits.
            ties = (votes >= best[:, None] * (1 - 1e-12)) & (weight > 0)
            winner = np.where(ties, labels, np.iinfo(np.int32).max).min(axis=1)
            result[rows] = np.where(best > 0, winner, 0)
        return result

    def features(self, of_gaussian: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "P D"]:
        """Return the weighted mean of the Gaussians' features; zeros for points without Gaussians."""
        result = np.zeros((len(self.index), of_gaussian.shape[1]), dtype=of_gaussian.dtype)
        for rows in _chunks(len(self.index)):
            result[rows] = np.einsum("pk,pkd->pd", self.weight[rows], of_gaussian[self.index[rows]])
        return result


def carried_to(
    points: Float[np.ndarray, "P 3"], gaussians: Gaussians, mode: Mode, radius: float, threads: int = 1
) -> CarriedPoints:
    """Assign Gaussians to points; positions and the vote radius are in scene units.

    `frozen`: the fit must not have moved, split or dropped any Gaussian. As in OpenGaussian's
    `scripts/eval_scannet.py`, points whose Gaussian is transparent are not scored.
    `density`: the weight opacity * exp(-d**2 / 2), with Mahalanobis distance d, is the alpha that 3DGS
    blends at the point. Candidates are the nearest centres, so a large Gaussian with a distant centre has no
    weight. Weights are relative, so every point has a prediction, even far from all Gaussians.

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
                fix="fit with frozen points, or use mode nearest, vote or density",
            )
        index = np.arange(len(points), dtype=np.int64)[:, None]
        return CarriedPoints("frozen", index, np.ones(index.shape), opacities >= OPACITY_MIN)
    k, reach = NEIGHBOURS[mode], radius if mode == "vote" else np.inf
    index, distance = _neighbours(points, gaussians.means, opacities, k, reach, threads)
    if mode == "nearest":
        name, weight = "nearest", np.ones(index.shape)
    elif mode == "vote":
        name = f"vote of {k} within {radius:g}"
        weight = _normalised(np.where(np.isfinite(distance), opacities[index], 0.0))
    else:
        name = f"density of {k}"
        weight = _normalised(_densities(points, gaussians, opacities, index, distance))
    return CarriedPoints(name, index, weight, np.ones(len(points), dtype=bool))


def _densities(
    points: np.ndarray, gaussians: Gaussians, opacities: np.ndarray, index: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """Return opacity times Gaussian falloff at each point, up to a factor per point; 0 if out of range."""
    # Matrices (N, 3, 3) that map an offset from the centre to units of standard deviations.
    turns = rotation_matrices(gaussians.quats).transpose(0, 2, 1)
    whiten = turns / gaussians.scales.astype(float)[:, :, None]
    weight = np.empty(index.shape)
    for rows in _chunks(len(points)):
        offset = points[rows, None, :].astype(float) - gaussians.means[index[rows]]
        squared = (np.einsum("pkij,pkj->pki", whiten[index[rows]], offset) ** 2).sum(axis=2)
        log_weight = np.log(opacities[index[rows]].astype(float)) - squared / 2
        log_weight = np.where(np.isfinite(distance[rows]), log_weight, -np.inf)
        # Subtracting the maximum preserves the ratios and keeps the weights from all underflowing to zero.
        weight[rows] = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
    return weight


def classify(features: Float[np.ndarray, "P D"], texts: Float[np.ndarray, "K D"]) -> Int32[np.ndarray, " P"]:
    """Return labels 1 .. K by the largest cosine with the class texts (unit vectors); the first wins ties.

    Canonical phrases and a class "other" are not used. Departs: OpenGaussian's argmax assigns points without
    a feature (all zero) to its first class, wall; here they get label 0, a miss.
    """
    labels = np.zeros(len(features), dtype=np.int32)
    for rows in _chunks(len(features)):
        # The norm of a feature does not change which cosine is largest.
        scores = features[rows] @ texts.T
        labels[rows] = np.where(scores.any(axis=1), scores.argmax(axis=1) + 1, 0)
    return labels


def _neighbours(
    points: np.ndarray, means: np.ndarray, opacities: np.ndarray, k: int, radius: float, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return index and distance (P, k) of the nearest opaque Gaussians; missing ones have distance inf."""
    opaque = np.flatnonzero(opacities >= OPACITY_MIN)
    if not opaque.size:
        raise MisalignedArtifactError(
            "no Gaussian is opaque enough to label a point",
            expected=f"an opacity of at least {OPACITY_MIN}",
            found=f"{len(opacities)} Gaussians, all below",
            fix="check gaussians.ply; the fit has probably failed",
        )
    from scipy.spatial import cKDTree  # importing takes 0.2 s and is needed only for points

    tree = cKDTree(means[opaque].astype(float))
    bound = np.nextafter(radius, np.inf)  # the radius is inclusive
    distance, place = tree.query(
        points.astype(float), k=np.arange(1, k + 1), distance_upper_bound=bound, workers=threads
    )
    return opaque[np.where(np.isfinite(distance), place, 0)].astype(np.int64), distance


def _normalised(weight: np.ndarray) -> np.ndarray:
    total = weight.sum(axis=1, keepdims=True)
    return np.divide(weight, total, out=np.zeros_like(weight, dtype=float), where=total > 0)


def _chunks(length: int) -> list[slice]:
    return [slice(start, start + CHUNK_POINTS) for start in range(0, length, CHUNK_POINTS)]
