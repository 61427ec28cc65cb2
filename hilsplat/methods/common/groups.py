"""Groups of Gaussians with similar features, and each group's code from the masks that show it."""

import warnings
from typing import Literal

import numpy as np
import scipy.cluster.hierarchy
import scipy.sparse as sp
from jaxtyping import Float, Float32, Float64, Int, Int32, Int64, Shaped
from scipy.cluster.vq import kmeans2, vq
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hilsplat.base.levels import LEVELS, NONE
from hilsplat.field.code import unit_rows
from hilsplat.methods.method import MethodInputs
from hilsplat.semantic_tree.nodes import level_ious

ROUNDS = 20  # Lloyd iterations; more would reduce the error by less than 1 %
CENTRES = 256  # k-means centres that `clusters` merges
KMEANS_ROUNDS = 10  # Lloyd iterations for these centres
MIN_SCORE = 0.2  # minimum score of masks averaged for a group's code; OpenGaussian's value for ScanNet
MIN_VIEWS = 2  # minimum number of views for a group's code; OpenGaussian's value for ScanNet (for LERF, 5)


def kmeans(
    vectors: Float32[np.ndarray, "n C"], count: int, seed: int, rounds: int = ROUNDS
) -> tuple[Float32[np.ndarray, "E C"], Int64[np.ndarray, " n"]]:
    """Return k-means centroids from distant starts (k-means++), and each vector's nearest centroid.

    If at most `count` vectors are distinct, these are the centroids, and the first fills the rest. In the
    `rounds` Lloyd iterations, a centroid that loses its last vector keeps its position.
    """
    if not len(vectors):
        return np.zeros((count, vectors.shape[1]), np.float32), np.zeros(0, np.int64)
    data = vectors.astype(np.float64)
    starts = _distant_rows(data, count, np.random.default_rng(seed))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty")
        centroids, _ = kmeans2(data, starts, iter=rounds, minit="matrix")
    return centroids.astype(np.float32), vq(data, centroids, check_finite=False)[0].astype(np.int64)


def _distant_rows(
    data: Float[np.ndarray, "n C"], count: int, random: np.random.Generator
) -> Float[np.ndarray, "E C"]:
    """Draw k-means++ starts, in proportion to squared distance; scipy's function takes E times as long."""
    chosen = np.full(count, -1, np.int64)
    square, chances = np.full(len(data), np.inf), np.arange(1.0, len(data) + 1)
    for number in range(count):
        if chances[-1] == 0:
            break  # every row is already a start
        draw = random.random() * chances[-1]
        chosen[number] = min(int(np.searchsorted(chances, draw, side="right")), len(data) - 1)
        np.minimum(square, np.square(data - data[chosen[number]]).sum(axis=1), out=square)
        chances = square.cumsum()
    return data[np.where(chosen < 0, chosen[0], chosen)]


def standardised(means: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    """Centre the Gaussians' positions and scale them to a standard deviation of 1 over all three axes."""
    apart = means - means.mean(axis=0)
    return apart / max(float(apart.std()), 1e-12)


def nearest(points: Shaped[np.ndarray, "n C"], count: int) -> Int64[np.ndarray, "n k"]:
    """Return the `count` nearest points (or all) of each point, itself included, nearest first."""
    count = min(count, len(points))
    return cKDTree(points).query(points, count)[1].reshape(len(points), count)


def group_means(
    rows: Float[np.ndarray, "n D"], group: Int[np.ndarray, " n"], num: int
) -> tuple[Float64[np.ndarray, "T D"], Int64[np.ndarray, " T"]]:
    """Return the mean of the rows of each of `num` groups (0 if empty), and the number of rows."""
    counts = np.bincount(group, minlength=num)
    sums = np.stack([np.bincount(group, column, num) for column in rows.T], axis=1)
    return sums / np.maximum(counts, 1)[:, None], counts


def features_of_groups(
    group: Int32[np.ndarray, " N"] | Int64[np.ndarray, " N"], latents: Float32[np.ndarray, "T D"]
) -> Float32[np.ndarray, "N D"]:
    """Return the code of each Gaussian's group; 0 for Gaussians without a group."""
    nothing = np.zeros((1, latents.shape[1]), np.float32)
    return np.concatenate([latents, nothing])[group]


def associated_codes(
    inputs: MethodInputs,
    group: Int64[np.ndarray, " N"],  # -1 for none
    rows: Int64[np.ndarray, " m"],  # candidate masks
    features: Float32[np.ndarray, "N C"] | None = None,
) -> Float32[np.ndarray, "N D"]:
    """Return the code of each Gaussian's group: the average over the best-fitting mask of each view.

    Source: yanmin-wu/OpenGaussian `train.py`. Departs: the IoU uses visible weights instead of a group
    rendered alone, so that hidden Gaussians do not count.

    A mask's score is its IoU with the group, multiplied (if `features` is given) by 1 minus the mean absolute
    difference between the mean features of mask and group. It must exceed `MIN_SCORE`. Groups with masks in
    fewer than `MIN_VIEWS` views get 0; in a scene with only one view, one is enough.
    """
    contributions = inputs.contributions
    weights, mass = contributions.matrix("S")[rows].astype(np.float64), contributions.matrix("mass")
    iou = level_ious(group.astype(np.int32), weights, mass, contributions.view[rows]).tocoo()
    num_groups, score = iou.shape[1], iou.data
    mask, of = iou.row.astype(np.int64), iou.col.astype(np.int64)
    view = contributions.view[rows][mask]
    if features is not None:
        has = np.flatnonzero(group != NONE)
        of_mask = contributions.matrix("A")[rows] @ features
        of_group, _ = group_means(features[has], group[has], num_groups)
        score = score * (1 - np.abs(of_mask[mask] - of_group[of]).mean(axis=1))
    order = np.lexsort((mask, -score, of, view))
    key = view[order].astype(np.int64) * num_groups + of[order]
    first = order[np.flatnonzero(np.diff(key, prepend=-1))]
    best = first[score[first] > MIN_SCORE]
    means, counts = group_means(inputs.latents[rows[mask[best]]], of[best], num_groups)
    has_code = counts >= min(MIN_VIEWS, mass.shape[0])
    return features_of_groups(group, np.where(has_code[:, None], means, 0).astype(np.float32))


def cluster_field(inputs: MethodInputs, group: Int64[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3 D"]:
    """Return the code of each Gaussian's cluster at each level; masks of all levels compete.

    A level without masks gets zeros, as in methods that learn each level from that level's masks.
    """
    every, features = np.arange(len(inputs.contributions)), inputs.no_features()
    for level in LEVELS:
        if len(inputs.contributions.rows_of(level)):
            features[:, level.index] = associated_codes(inputs, group[:, level.index], every)
    return features


def clusters(
    features: Float32[np.ndarray, "N D"],
    distances: tuple[float, ...],
    seed: int,
    metric: Literal["cosine", "euclidean"],
    count: int = CENTRES,
) -> Int64[np.ndarray, "N K"]:
    """Return each row's cluster at every distance: k-means centres, merged up to that average distance.

    Clusters at smaller distances are nested in clusters at larger distances. Cosine distance is 1 - cosine.
    """
    _, centre = kmeans(features, count, seed, KMEANS_ROUNDS)
    used, centre = np.unique(centre, return_inverse=True)
    if len(used) < 2:
        return np.zeros((len(features), len(distances)), np.int64)
    means, _ = group_means(features, centre, len(used))
    if metric == "cosine":
        means = unit_rows(means)
    joined = scipy.cluster.hierarchy.linkage(means, "average", metric)
    cut = [scipy.cluster.hierarchy.fcluster(joined, distance, "distance") - 1 for distance in distances]
    return np.stack(cut, axis=1)[centre].astype(np.int64)


def density_clusters(
    points: Float32[np.ndarray, "n D"], radius: float, min_points: int
) -> Int64[np.ndarray, " n"]:
    """Return each point's cluster, -1 for none: dense points within the radius are connected (DBSCAN*).

    A point is dense if at least `min_points` points, including itself, are within the radius. Clusters are
    numbered in the order of their first points (Campello et al., PAKDD 2013).
    """
    dense = cKDTree(points).query_ball_point(points, radius, return_length=True) >= min_points
    cluster = np.full(len(points), NONE, np.int64)
    where = np.flatnonzero(dense)
    pairs = cKDTree(points[where]).query_pairs(radius, output_type="ndarray")
    graph = sp.csr_matrix((np.ones(len(pairs), bool), pairs.T), shape=(len(where), len(where)))
    cluster[where] = connected_components(graph, directed=False)[1]
    return cluster
