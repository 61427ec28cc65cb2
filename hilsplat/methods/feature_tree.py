"""A semantic tree from clustered features: a literal reading of the paper's 3D hierarchical clustering.

1. Every Gaussian learns an identity feature for each level from the loss L = L_h + lambda_1 L_ins + lambda_2
   L_part (paper, Sec. III-C) alone, without language.
2. Gaussians are clustered coarse to fine: wholes by whole-level features, then parts inside wholes, then
   subparts inside parts. Clusters closer than half the median distance of two masks that share a view and a
   parent are merged.
3. A cluster's vector is computed from the CLIP vectors of the best-fitting masks of its level, as in
   OpenGaussian. Parents are determined by containment, as for linked masks.

The paper only states "train and cluster point-level features"; the distance threshold is ours.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.contributions.rows import Contributions
from hilsplat.field.contrast import read_parents
from hilsplat.field.field import field_losses
from hilsplat.field.solver import solve_field
from hilsplat.methods.common.groups import CENTRES, clusters, group_means
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.semantic_tree.nodes import MIN_FIT, LevelNodes, best_fits, level_ious
from hilsplat.settings import FieldSettings, SemanticTreeSettings

CENTRE_OF = 4  # minimum number of Gaussians per k-means centre
STEPS = 60  # number of L-BFGS steps
RIDGE = 1e-3  # weight of the pull towards the random start; prevents drift in unobserved directions


def merge_distances(
    means: Float32[np.ndarray, "M D"], contributions: Contributions, parents: dict[str, np.ndarray]
) -> tuple[float, ...]:
    """Return, per level, half the median distance between masks that share a view and a parent."""
    distances: list[list[float]] = [[] for _ in LEVELS]
    for view, rows in zip(contributions.views, contributions.rows_of_views(), strict=True):
        level, parent = contributions.level[rows], parents[view]
        usable = contributions.pixels[rows] > 0
        alike = (level[:, None] == level) & (parent[:, None] == parent) & usable[:, None] & usable
        for a, b in np.argwhere(np.triu(alike, 1)):
            distances[level[a] - 1].append(float(np.linalg.norm(means[rows[a]] - means[rows[b]])))
    return tuple(0.5 * float(np.median(values)) if values else np.inf for values in distances)


def nested_clusters(
    features: Float32[np.ndarray, "N 3 D"], farthest: tuple[float, ...], seed: int
) -> Int64[np.ndarray, "N 3"]:
    """Return each Gaussian's cluster per level, -1 if its feature is NaN; clusters are nested.

    Clusters are divided by k-means; centres with an average distance of at most `farthest` are merged.
    """
    nested = np.full(features.shape[:2], NONE, np.int64)
    around = np.zeros(len(features), np.int64)
    for level in LEVELS:
        has = ~np.isnan(features[:, level.index, 0])
        number = 0
        for cluster in np.unique(around[has]):
            inside = np.flatnonzero(has & (around == cluster))
            rows, distance = features[inside, level.index], farthest[level.index]
            count = int(np.clip(len(rows) // CENTRE_OF, 1, CENTRES))
            cluster_of_row = clusters(rows, (distance,), seed, "euclidean", count)[:, 0]
            nested[inside, level.index] = number + cluster_of_row
            number += int(cluster_of_row.max()) + 1
        # Gaussians without a cluster remain grouped by their whole, with negative numbers.
        around = np.where(has, nested[:, level.index], np.where(around < 0, around, -2 - around))
    return nested


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
    """Write a semantic tree whose nodes are clusters of features trained with the loss L alone.

    Results do not depend on `threads`.

    Raises:
        MisalignedArtifactError: an input belongs to different masks.
    """
    contributions = Contributions.load(contributions_folder)
    parents = read_parents(coverage_folder, contributions)
    is_quadratic = not (field_settings.weight_instance or field_settings.weight_part)
    alone = {"weight_language": 0.0, "ridge": RIDGE, "lbfgs_steps": STEPS, "prune_cosine": 1.0}
    alone["cg_steps"] = STEPS if is_quadratic else 0
    losses = field_settings.model_copy(update=alone)
    no_latents = np.zeros((len(contributions), settings.feature_size), np.float32)
    problem, contrast = field_losses(contributions, parents, no_latents, losses, "random", seed, threads)
    features, _ = solve_field(problem, contrast)
    farthest = merge_distances(problem.masks.means(features), contributions, parents)
    features = np.where((problem.mass > 0)[:, :, None], features, np.float32(np.nan))
    clusters = nested_clusters(features, farthest, seed)
    S, mass = contributions.matrix("S"), contributions.matrix("mass")

    def nodes(level: Level) -> LevelNodes:
        rows = contributions.rows_of(level)
        cluster, view = clusters[:, level.index], contributions.view[rows]
        fits, iou = best_fits(level_ious(cluster.astype(np.int32), S[rows], mass, view))
        of_mask = np.where(iou > MIN_FIT, fits, NONE).astype(np.int64)
        number = int(cluster.max(initial=NONE)) + 1
        pairs = np.unique(np.stack([of_mask, view], axis=1)[of_mask != NONE], axis=0)
        with_views = np.flatnonzero(np.bincount(pairs[:, 0], minlength=number) >= settings.min_views)
        renumber = np.full(number + 1, NONE, np.int64)
        renumber[with_views] = np.arange(len(with_views))
        quality, _ = group_means(iou[of_mask != NONE, None], of_mask[of_mask != NONE], number)
        of_gaussian = renumber[cluster].astype(np.int32)
        return LevelNodes(
            renumber[of_mask], of_gaussian, (of_gaussian != NONE).astype(np.float32), quality[with_views, 0]
        )

    run_semantic_tree(contributions_folder, masks_folder, out, settings, threads, map(nodes, LEVELS))
