"""The losses L_ins and L_part (paper, Eq. 3 to 5) of one view, each in two variants, with gradients.

The losses compare a few dozen masks at a time, so the gradients are written in NumPy: importing torch takes
longer than computing all gradients of a solve. The tests compare the gradients with autograd.
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int32, Int64

from hilsplat.base.levels import NONE

SOFTENING = 1e-3  # added in quadrature to every distance, so that its logarithm has a finite slope at zero
MIN_LENGTH = 1e-6  # added in quadrature to lengths in denominators, so that the cosine of a zero vector is 0


def log_distance_loss(
    means: Float[np.ndarray, "M D"], log_wanted: Float[np.ndarray, "M M"]
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """Return the mean squared difference between actual and target log distances of pairs, and its gradient.

    The distance is sqrt(|m_i - m_j|^2 + SOFTENING^2), i != j. Squares are computed from dot products, which
    need M x M numbers instead of M x M x D. In float64, the cancellation error is far below the softening. At
    least two means are required; `log_wanted` is the natural logarithm of each pair's target distance.
    """
    rows = len(means)
    centred = means - means.mean(axis=0)
    squares = np.square(centred).sum(axis=1)
    apart = squares[:, None] + squares[None] - 2 * centred @ centred.T
    softened = np.maximum(apart, 0) + SOFTENING**2
    residual = 0.5 * np.log(softened) - log_wanted
    np.fill_diagonal(residual, 0)
    pairs = rows * (rows - 1)
    by_apart = np.where(apart >= 0, residual / softened, 0) / pairs
    both = by_apart + by_apart.T
    gradient = 2 * (both.sum(axis=1)[:, None] * centred - both @ centred)
    return float(np.square(residual).sum() / pairs), gradient


def instance_loss_literal(
    means: Float[np.ndarray, "M D"], level: Int[np.ndarray, " M"], omega: float
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """Compute L_ins as printed (Eq. 3): the target distance of two masks is Omega^-|l_i - l_j|.

    This pushes all masks of the same level, related or not, to distance 1, which is impossible for more than
    D + 1 masks. Departs only in the softened distance. `means` contains the mean rendered feature of each
    mask of one view, at all levels; Omega exceeds 1.
    """
    return log_distance_loss(means, -np.abs(level[:, None] - level[None]) * math.log(omega))


def instance_loss_tree(
    means: Float[np.ndarray, "M D"], depth: Int[np.ndarray, "M M"], omega: float
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """Compute L_ins by tree relation instead of level: the target distance is Omega^-depth.

    Departs: the depth of the deepest common ancestor in the coverage tree replaces |l_i - l_j| of Eq. 3.
    Unrelated masks thus have a target distance of 1, parts of one object 1 / Omega, and subparts of one part
    1 / Omega^2, which is the nesting that the paper's text describes.
    """
    return log_distance_loss(means, -depth * math.log(omega))


def common_ancestor_depth(parent: Int32[np.ndarray, " M"]) -> Int64[np.ndarray, "M M"]:
    """Return the depth of each mask pair's deepest common ancestor in one view's coverage tree.

    A mask counts as its own ancestor, and roots have depth 1; 0 means that two masks are unrelated. The value
    for a mask and its child is the mask's depth; for two children of a root, it is 1.

    Example:
        >>> common_ancestor_depth(np.array([-1, 0, 0, 1], dtype=np.int32))[3]
        array([1, 2, 1, 3])
    """
    rows = len(parent)
    is_ancestor = np.eye(rows, dtype=np.int64)  # [mask, ancestor]
    current = np.arange(rows)
    for _ in range(rows):
        current = np.where(current == NONE, NONE, parent[current])
        has = np.flatnonzero(current != NONE)
        if not len(has):
            break
        is_ancestor[has, current[has]] = 1
    # Common ancestors of two masks form a chain from the root down, so the number of ancestors is the
    # depth. Counts in float32 are exact, and float32 products are fast.
    chains = is_ancestor.astype(np.float32)
    return (chains @ chains.T).astype(np.int64)


Pullback = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function from gradients of similarities (A, B) to gradients of anchors (A, D) and others (B, D)."""


def similarity_without_parent(
    anchors: Float[np.ndarray, "A D"], others: Float[np.ndarray, "B D"], parent: Float[np.ndarray, "A D"]
) -> tuple[Float64[np.ndarray, "A B"], Pullback]:
    """Compute s_p of Eq. 4: cosine of two mask means after subtracting the anchor's parent mean from both.

    Departs: Eq. 4 prints index j twice in the denominator; we use i and j, so that s_p is a cosine. The
    parent mean in Eq. 4 has no index; we use the anchor's parent for both positives and negatives. The parent
    gets no gradient: parts move relative to their whole, not the whole relative to its parts.
    """
    centred = anchors - parent
    square = np.square(centred).sum(axis=1, keepdims=True) + MIN_LENGTH**2
    along = centred @ others.T - (centred * parent).sum(axis=1, keepdims=True)
    # |other - parent|^2 from dot products, which needs A x B numbers instead of A x B x D
    far = np.square(others).sum(axis=1) - 2 * parent @ others.T + np.square(parent).sum(axis=1, keepdims=True)
    softened = np.maximum(far, 0) + MIN_LENGTH**2
    scale = 1 / np.sqrt(square * softened)
    similarity = along * scale

    def pull_back(by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        by_along, shrinking = by * scale, by * similarity
        by_far = np.where(far >= 0, -0.5 * shrinking / softened, 0)
        by_own = by_along @ others - by_along.sum(axis=1, keepdims=True) * parent
        by_own -= shrinking.sum(axis=1, keepdims=True) / square * centred
        by_others = by_along.T @ centred + 2 * (by_far.sum(axis=0)[:, None] * others - by_far.T @ parent)
        return by_own, by_others

    return similarity, pull_back


def part_loss_literal(
    means: Float[np.ndarray, "M D"],  # mean rendered feature of each mask of the level
    parent: Int[np.ndarray, " M"],  # id of each mask's parent, -1 for an orphan
    parent_means: Float[np.ndarray, "M D"],  # any value for orphans
    tau: float,
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """Compute L_part of one view and level as printed (Eq. 5): siblings attract, other masks repel.

    The denominator contains only the negatives, as printed. This pulls siblings ("bear nose" and "bear
    mouth") together, whereas the paper's text states that siblings are separated.

    Departs: we interpret 1 / (L N_p) as the mean, over anchors with at least one positive and one negative,
    of the mean over each anchor's positives. The caller omits level l = 1, which has no parents; orphans are
    omitted here. An anchor is not its own positive. Without anchors, the loss is 0.
    """
    similarity, pull_back = similarity_without_parent(means, means, parent_means)
    has_parent = parent != NONE
    comparable = has_parent[:, None] & has_parent[None]
    same = parent[:, None] == parent[None]
    positive, negative = comparable & same & ~np.eye(len(means), dtype=bool), comparable & ~same
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
    half: Float[np.ndarray, "M D"],  # means over a random half of each mask's pixels; at least two masks
    other_half: Float[np.ndarray, "M D"],  # means over the remaining pixels
    has_parent: Bool[np.ndarray, " M"],  # masks with a parent, which are the anchors; at least one
    parent_means: Float[np.ndarray, "M D"],  # any value for orphans
    tau: float,
) -> tuple[float, Float64[np.ndarray, "M D"], Float64[np.ndarray, "M D"]]:
    """Compute L_part of one view and level as in the paper's text: parts of one object are separated.

    Departs: the positive of a mask is the other random half of its own pixels; negatives are the other
    halves of all other masks of the level, including siblings; the denominator includes the positive
    (InfoNCE). The anchor's parent mean is subtracted from all features. The loss is the mean over anchors.
    """
    by_half = np.zeros(half.shape)
    anchors = np.flatnonzero(has_parent)
    similarity, pull_back = similarity_without_parent(half[anchors], other_half, parent_means[anchors])
    scaled = similarity / tau
    total, shares = log_sum_exp(scaled)
    positives = np.arange(len(anchors)), anchors
    loss = float((total - scaled[positives]).mean())
    shares[positives] -= 1
    by_half[anchors], by_other = pull_back(shares / (len(anchors) * tau))
    return loss, by_half, by_other


def log_sum_exp(
    values: Float64[np.ndarray, "A B"],
) -> tuple[Float64[np.ndarray, " A"], Float64[np.ndarray, "A B"]]:
    """Return the log-sum-exp of each row, and the gradient, which is the softmax."""
    largest = values.max(axis=1, keepdims=True)
    powers = np.exp(values - largest)
    total = powers.sum(axis=1, keepdims=True)
    return (np.log(total) + largest)[:, 0], powers / total
