"""The part-wise loss L_part (paper, Eq. 4 and 5) in two variants, with its gradient."""

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from hilsplat.base.levels import NONE
from hilsplat.field.losses.distances import similarity_without_parent


def part_loss_literal(
    means: Float[np.ndarray, "M D"],
    parent: Int[np.ndarray, " M"],
    parent_means: Float[np.ndarray, "M D"],
    tau: float,
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """Compute L_part of one view and level as printed (Eq. 5): siblings attract, children of others repel.

    The denominator contains only the negatives, as printed. This pulls siblings together ("bear nose" and
    "bear mouth"), whereas the paper's text says to separate them.

    Departs: we read 1 / (L N_p) as the mean, over anchors with at least one positive and one negative, of
    the mean over their positives. The caller omits level l = 1, which has no parents; this function omits
    orphans. An anchor is not its own positive.

    Args:
        means: mean rendered feature of each mask of the level.
        parent: id of each mask's parent, -1 for an orphan.
        parent_means: mean feature of each mask's parent (any value for orphans).
        tau: temperature.

    Returns:
        mean over anchors, 0 if there are none; and its gradient with respect to the means.
    """
    similarity, pull_back = similarity_without_parent(means, means, parent_means)
    has_parent = parent != NONE
    both = has_parent[:, None] & has_parent[None]
    same = parent[:, None] == parent[None]
    positive, negative = both & same & ~np.eye(len(means), dtype=bool), both & ~same
    anchors = np.flatnonzero(positive.any(axis=1) & negative.any(axis=1))
    if not len(anchors):
        return 0.0, np.zeros(means.shape)
    scaled, positive, negative = similarity[anchors] / tau, positive[anchors], negative[anchors]
    repulsion, shares = log_sum_exp(np.where(negative, scaled, -np.inf))
    attracting = positive / positive.sum(axis=1, keepdims=True)
    by_similarity = np.zeros(similarity.shape)
    by_similarity[anchors] = (shares - attracting) / (len(anchors) * tau)
    by_anchors, by_others = pull_back(by_similarity)
    return float((repulsion - (scaled * attracting).sum(axis=1)).mean()), by_anchors + by_others


def part_loss_disentangle(
    half: Float[np.ndarray, "M D"],
    other_half: Float[np.ndarray, "M D"],
    has_parent: Bool[np.ndarray, " M"],
    parent_means: Float[np.ndarray, "M D"],
    tau: float,
) -> tuple[float, Float64[np.ndarray, "M D"], Float64[np.ndarray, "M D"]]:
    """Compute L_part of one view and level as the paper describes it: parts of one object are separated.

    Departs: the positive of a mask is the other random half of its own pixels; negatives are the other
    halves of all other masks of the level, including siblings; the denominator includes the positive
    (InfoNCE). The anchor's parent mean is subtracted from all features.

    Args:
        half: mean feature over a random half of each mask's pixels.
        other_half: mean over the remaining pixels.
        has_parent: masks with a parent, which are the anchors.
        parent_means: mean feature of each mask's parent (any value for orphans).
        tau: temperature.

    Returns:
        mean over anchors, 0 if there are none or only one mask; and its gradients with respect to the halves.
    """
    by_half = np.zeros(half.shape)
    anchors = np.flatnonzero(has_parent)
    if not len(anchors) or len(half) < 2:
        return 0.0, by_half, np.zeros(half.shape)
    similarity, pull_back = similarity_without_parent(half[anchors], other_half, parent_means[anchors])
    scaled = similarity / tau
    total, shares = log_sum_exp(scaled)
    own = np.arange(len(anchors)), anchors
    loss = float((total - scaled[own]).mean())
    shares[own] -= 1
    by_half[anchors], by_other = pull_back(shares / (len(anchors) * tau))
    return loss, by_half, by_other


def log_sum_exp(
    values: Float64[np.ndarray, "A B"],
) -> tuple[Float64[np.ndarray, " A"], Float64[np.ndarray, "A B"]]:
    """Return the log-sum-exp of each row and its gradient, the softmax."""
    most = values.max(axis=1, keepdims=True)
    powers = np.exp(values - most)
    total = powers.sum(axis=1, keepdims=True)
    return (np.log(total) + most)[:, 0], powers / total
