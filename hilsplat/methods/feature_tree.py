"""A semantic tree from clustered features: a literal reading of the paper's 3D hierarchical clustering.

1. Every Gaussian learns an identity feature for each level by L = L_h + lambda_1 L_ins + lambda_2 L_part
   alone (paper, Sec. III-C), without language.
2. Gaussians are clustered coarse to fine: wholes by their features at level whole, then parts inside wholes,
   subparts inside parts. Clusters closer than half the median distance of two masks that share a view and a
   parent are merged.
3. A cluster's vector is computed from the CLIP vectors of the masks of its level that fit it best, as in
   OpenGaussian. Parents follow from containment, as for linked masks.

The paper only states "train and cluster point-level features"; the distance threshold is ours.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.rows import Contributions
from hilsplat.field.contrast import Contrast, view_relations
from hilsplat.field.field import read_parents
from hilsplat.field.problem import QuadraticProblem
from hilsplat.field.solver import solve_field
from hilsplat.methods.common.groups import CENTRES, group_means, merged_centres
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.semantic_tree.level_nodes import MIN_FIT, LevelNodes
from hilsplat.semantic_tree.nodes import best_fits, level_ious
from hilsplat.settings import FieldSettings, SemanticTreeSettings

CENTRE_OF = 4
"""Minimum number of Gaussians per centre."""

STEPS = 60
"""L-BFGS steps of the features."""

RIDGE = 1e-3
"""Weight of the penalty towards the random start, which keeps unobserved directions from drifting."""


def identity_features(
    contributions: Contributions,
    parents: dict[str, np.ndarray],
    settings: FieldSettings,
    size: int,
    steps: int,
    seed: int,
    threads: int,
) -> tuple[Float32[np.ndarray, "N 3 D"], Float32[np.ndarray, "M D"]]:
    """Train features with L alone, from a random start.

    Args:
        parents: per view, the coverage tree's parent of each mask.
        settings: weights and readings of L_h, L_ins and L_part.
        steps: L-BFGS steps.
        threads: threads for matrix products; the result does not depend on it.

    Returns:
        features, nan for Gaussians in no mask of a level; the mean feature of each mask.
    """
    alone = {"weight_language": 0.0, "ridge": RIDGE, "start": "random", "cg_steps": 0, "lbfgs_steps": steps}
    settings = settings.model_copy(update=alone)
    masks, halves = (
        MaskOperator.of(contributions.matrix(name), contributions.level, threads) for name in ("A", "A_half")
    )
    pixels = contributions.pixels.astype(np.float32)
    no_latents = np.zeros((len(contributions), size), np.float32)
    weights = (0.0, settings.weight_clustering, settings.ridge)
    problem = QuadraticProblem.of(
        masks, contributions.quadratic(threads), pixels, no_latents, weights, "random", seed
    )
    relations = view_relations(contributions, parents, settings)
    half_pixels = contributions.half_pixels.astype(np.float32)
    contrast = Contrast(masks, halves, pixels, half_pixels, relations, settings)
    features, _ = solve_field(problem, contrast, settings)
    means = masks.means(features)
    return np.where((problem.mass > 0)[:, :, None], features, np.nan).astype(np.float32), means


def farthest_alike(
    means: Float32[np.ndarray, "M D"], contributions: Contributions, parents: dict[str, np.ndarray]
) -> tuple[float, ...]:
    """Return, per level, half the median distance of two masks that share a view, a level and a parent."""
    found: list[list[float]] = [[] for _ in LEVELS]
    for view, rows in zip(contributions.views, contributions.rows_of_views(), strict=True):
        level, parent = contributions.level[rows], parents[view]
        usable = contributions.pixels[rows] > 0
        alike = (level[:, None] == level) & (parent[:, None] == parent) & usable[:, None] & usable
        for a, b in np.argwhere(np.triu(alike, 1)):
            found[level[a] - 1].append(float(np.linalg.norm(means[rows[a]] - means[rows[b]])))
    return tuple(0.5 * float(np.median(values)) if values else np.inf for values in found)


def joined_clusters(
    features: Float32[np.ndarray, "n D"], farthest: float, seed: int
) -> Int64[np.ndarray, " n"]:
    """Return each row's cluster: k-means centres, merged up to an average distance of `farthest`."""
    count = int(np.clip(len(features) // CENTRE_OF, 1, CENTRES))
    return merged_centres(features, count, (farthest,), seed, "euclidean")[:, 0]


def nested_clusters(
    features: Float32[np.ndarray, "N 3 D"], farthest: tuple[float, ...], seed: int
) -> Int64[np.ndarray, "N 3"]:
    """Return each Gaussian's cluster per level, -1 where its feature is nan; clusters nest."""
    found = np.full(features.shape[:2], NONE, np.int64)
    around = np.zeros(len(features), np.int64)
    for level in LEVELS:
        has = ~np.isnan(features[:, level.index, 0])
        number = 0
        for cluster in np.unique(around[has]):
            inside = np.flatnonzero(has & (around == cluster))
            own = joined_clusters(features[inside, level.index], farthest[level.index], seed)
            found[inside, level.index] = number + own
            number += int(own.max()) + 1
        # Gaussians without a cluster remain grouped by their whole.
        around = np.where(has, found[:, level.index], -2 - around)
    return found


def run_feature_tree(
    contributions_folder: Path,
    masks_folder: Path,
    coverage_folder: Path,
    out: Path,
    settings: SemanticTreeSettings,
    field_settings: FieldSettings,
    seed: int,
    threads: int,
) -> None:
    """Write a semantic tree whose nodes are clusters of features trained with L alone.

    Args:
        out: output folder, as in `run_semantic_tree`.
        field_settings: weights and readings of L.
        threads: number of threads; results do not depend on it.

    Raises:
        MisalignedArtifactError: an input belongs to other masks.
    """
    contributions = Contributions.load(contributions_folder)
    parents = read_parents(coverage_folder, contributions)
    features, means = identity_features(
        contributions, parents, field_settings, settings.feature_size, STEPS, seed, threads
    )
    clusters = nested_clusters(features, farthest_alike(means, contributions, parents), seed)
    S, mass = contributions.matrix("S"), contributions.mass()

    def nodes_of(level: Level, rows: Int64[np.ndarray, " m"]) -> LevelNodes:
        own, view = clusters[:, level.index], contributions.view[rows]
        fits, iou = best_fits(level_ious(own.astype(np.int32), S[rows], mass, view))
        of_mask = np.where(iou > MIN_FIT, fits, NONE).astype(np.int64)
        number = int(own.max(initial=NONE)) + 1
        pairs = np.unique(np.stack([of_mask, view], axis=1)[of_mask != NONE], axis=0)
        kept = np.flatnonzero(np.bincount(pairs[:, 0], minlength=number) >= settings.min_views)
        renumber = np.full(number + 1, NONE, np.int64)
        renumber[kept] = np.arange(len(kept))
        quality, _ = group_means(iou[of_mask != NONE, None], of_mask[of_mask != NONE], number)
        of_gaussian = renumber[own].astype(np.int32)
        return LevelNodes(
            renumber[of_mask], of_gaussian, (of_gaussian != NONE).astype(np.float32), quality[kept, 0]
        )

    run_semantic_tree(contributions_folder, masks_folder, out, settings, threads, nodes_of)
