"""Softened distances, ancestors and cosines of the instance and part losses, with their gradients.

The losses compare a few dozen masks at a time, so their gradients are written in NumPy: torch takes longer to
start than a solve takes to compute them. The tests compare them with autograd.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float64, Int32, Int64

from hilsplat.base.levels import NONE

SOFTENING = 1e-3
"""Added in quadrature to every distance, so that its logarithm has a finite slope at zero."""

SHORTEST = 1e-6
"""Added in quadrature to every length in a denominator, so that the cosine of a zero vector is zero."""


def log_distance_loss(
    means: Float[np.ndarray, "M D"], log_wanted: Float[np.ndarray, "M M"]
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """Return the mean over ordered pairs i != j of the squared difference of log distances, and its gradient.

    The distance is sqrt(|m_i - m_j|^2 + SOFTENING^2). Squares are computed from dot products: M x M
    instead of M x M x D numbers. In float64 the cancellation error is far below the softening.

    Args:
        means: at least two rows.
        log_wanted: natural logarithm of the target distance of each pair.
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


def common_ancestor_depth(parent: Int32[np.ndarray, " M"]) -> Int64[np.ndarray, "M M"]:
    """Return the depth of the deepest common ancestor of every pair of masks in one view's coverage tree.

    A mask counts as its own ancestor and roots have depth 1; 0 means that two masks are unrelated. The value
    for a mask and its child is the depth of the mask; for two children of a root it is 1.

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
    # Common ancestors of two masks form a chain from the root down, so their number is the depth.
    # float32 counts exactly, and its products are fast.
    chains = is_ancestor.astype(np.float32)
    return (chains @ chains.T).astype(np.int64)


Pullback = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function from gradients of similarities (A, B) to gradients of anchors (A, D) and others (B, D)."""


def similarity_without_parent(
    anchors: Float[np.ndarray, "A D"], others: Float[np.ndarray, "B D"], parent: Float[np.ndarray, "A D"]
) -> tuple[Float64[np.ndarray, "A B"], Pullback]:
    """Compute s_p of Eq. 4: cosine of two mask means after subtracting the anchor's parent mean from both.

    Departs: Eq. 4 prints index j twice in the denominator; we use i and j, so that s_p is a cosine. We
    interpret its parent mean, which has no index, as the anchor's, for positives and negatives alike. The
    parent gets no gradient: parts move relative to their whole, not the whole relative to its parts.
    """
    own = anchors - parent
    square = np.square(own).sum(axis=1, keepdims=True) + SHORTEST**2
    along = own @ others.T - (own * parent).sum(axis=1, keepdims=True)
    # |other - parent|^2 from dot products: A x B instead of A x B x D numbers
    far = np.square(others).sum(axis=1) - 2 * parent @ others.T + np.square(parent).sum(axis=1, keepdims=True)
    softened = np.maximum(far, 0) + SHORTEST**2
    scale = 1 / np.sqrt(square * softened)
    similarity = along * scale

    def pull_back(by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        by_along, shrinking = by * scale, by * similarity
        by_far = np.where(far >= 0, -0.5 * shrinking / softened, 0)
        by_own = by_along @ others - by_along.sum(axis=1, keepdims=True) * parent
        by_own -= shrinking.sum(axis=1, keepdims=True) / square * own
        by_others = by_along.T @ own + 2 * (by_far.sum(axis=0)[:, None] * others - by_far.T @ parent)
        return by_own, by_others

    return similarity, pull_back
